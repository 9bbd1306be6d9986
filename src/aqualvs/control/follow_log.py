"""`follow.csv`: one row for every step of the controllers, on disk as soon as the step is taken."""

import csv
import io
import math
from pathlib import Path

from aqualvs.closing import Closing
from aqualvs.control.autopilot import Decision
from aqualvs.control.missions import bearing_of
from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import OutputError
from aqualvs.scanning.posture import Posture, Refusal

FOLLOW_COLUMNS = (
    *("time_s", "frame_time_s", "engaged", "stage", "reason"),
    *("posture", "range_m", "pitch_deg", "yaw_deg", "range_setpoint_m", "yaw_setpoint_deg"),
    *("range_error_m", "yaw_error_deg", "sway_m_s", "down_m_s", "forward", "right", "down", "yaw"),
    *("armed", "mode", "depth_m", "heading_deg", "bearing_deg"),
)
"""`posture` is "valid" or the reason of a refusal; errors are measured less wanted. Unknown values
are empty."""


class FollowLog(Closing):
    """Writer of the log, row by row.

    `path`: created, or overwritten. Raises `OutputError` if it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Unbuffered, so that rows survive the death of the process.
            self._file = path.open("wb", buffering=0)
        except OSError as fault:
            raise self._output_error(fault) from None
        self._append(FOLLOW_COLUMNS)

    def write(
        self,
        now_s: float,
        frame_time_s: float,
        posture: Posture | Refusal | None,
        decision: Decision,
        state: VehicleState,
    ) -> None:
        """Append the row of one step.

        Raises `OutputError` if it cannot be written.
        """
        guidance, effort = decision.guidance, decision.effort
        row = dict.fromkeys(FOLLOW_COLUMNS, "") | _seen(posture, decision, state)
        row |= {
            "time_s": f"{now_s:.4f}",
            "frame_time_s": f"{frame_time_s:.4f}",
            "engaged": str(int(decision.engaged)),
            "stage": guidance.stage.value,
            "reason": "" if decision.reason is None else decision.reason.value,
            "sway_m_s": f"{guidance.sway:.4f}",
            "down_m_s": f"{guidance.down:.4f}",
            "forward": f"{effort.forward:.4f}",
            "right": f"{effort.right:.4f}",
            "down": f"{effort.down:.4f}",
            "yaw": f"{effort.yaw:.4f}",
            "armed": str(int(state.armed)),
            "mode": state.mode_name or state.mode.value,
            "depth_m": "" if state.depth is None else f"{state.depth:.3f}",
            "heading_deg": _degrees(state.heading),
        }
        self._append([row[name] for name in FOLLOW_COLUMNS])

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._file.close()

    def _append(self, cells: list[str] | tuple[str, ...]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(cells)
        try:
            self._file.write(text.getvalue().encode("utf-8"))
        except OSError as fault:
            raise self._output_error(fault) from None

    def _output_error(self, fault: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: cannot be written ({fault.strerror}); make room, or "
            "choose another place"
        )


def _seen(
    posture: Posture | Refusal | None, decision: Decision, state: VehicleState
) -> dict[str, str]:
    """Return the cells that depend on a posture and its setpoint."""
    wanted = decision.guidance.setpoint
    row = {}
    if wanted is not None:
        row["range_setpoint_m"] = f"{wanted.range:.4f}"
        row["yaw_setpoint_deg"] = _degrees(wanted.yaw)
    if not isinstance(posture, Posture):
        row["posture"] = "" if posture is None else posture.reason.value
        return row
    row |= {
        "posture": "valid",
        "range_m": f"{posture.range:.5f}",
        "pitch_deg": _degrees(posture.pitch),
        "yaw_deg": _degrees(posture.yaw),
        "bearing_deg": _degrees(bearing_of(posture, state)),
    }
    if wanted is not None:
        row["range_error_m"] = f"{posture.range - wanted.range:.5f}"
        row["yaw_error_deg"] = _degrees(posture.yaw - wanted.yaw)
    return row


def _degrees(angle: float | None) -> str:
    return "" if angle is None else f"{math.degrees(angle):.3f}"
