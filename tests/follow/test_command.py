"""`aqualvs follow`: what it writes in simulation, what it refuses, and the pilot's keys."""

import csv
import io
import math
from pathlib import Path

import pytest

from aqualvs.cli.main import main
from aqualvs.control.follow_log import FOLLOW_COLUMNS
from aqualvs.errors import OptionError
from aqualvs.follow.command import FOLLOW_CSV, TRUTH_CSV, Aim, SimRequest, run_simulation
from aqualvs.follow.vehicle import listen
from aqualvs.results.files import RECORD

PLAN = """aqualvs_plan: 1
mission: follow
range_m: 0.6
sway_m_s: 0.2
leg:
  time_s: 2
"""


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without figures: drawing them takes most of the time of a short run."""
    monkeypatch.setattr("aqualvs.follow.report.drawn_follow_figures", lambda _: {})


def test_simulation_writes_log_figures_and_page(tmp_path: Path) -> None:
    told: list[str] = []
    request = SimRequest(out=tmp_path / "out", aim=Aim(range=0.7), seconds=3.0)
    assert run_simulation(request, lambda line: told.append(line)) == 0
    made = {path.name for path in request.out.iterdir()} - {RECORD}
    assert made == {FOLLOW_CSV, TRUTH_CSV, "figure_22.png", "figure_23.png", "follow.html"}
    with (request.out / FOLLOW_CSV).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == FOLLOW_COLUMNS
    assert {row["range_setpoint_m"] for row in rows} == {"0.7000"}
    # Frames at 25 Hz, the last two still on their way.
    assert 70 <= len(rows) <= 76
    page = (request.out / "follow.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert "range error, rms" in page
    assert "reversals of the thrusters a minute" in page
    assert any("rms" in line and "mm" in line for line in told)
    assert told[-1].endswith("follow.html")
    for name in ("figure_22.png", "figure_23.png"):
        assert (request.out / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("without_figures")
def test_a_picture_that_stands_still_steers_nobody(tmp_path: Path) -> None:
    told: list[str] = []
    request = SimRequest(out=tmp_path / "out", aim=Aim(range=0.6), seconds=4.0, freeze=2.0)
    assert run_simulation(request, lambda line: told.append(line)) == 0
    with (request.out / FOLLOW_CSV).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    share = sum(row["stage"] == "holding" and not row["reason"] for row in rows) / len(rows)
    assert 0.4 < share < 0.7
    (line,) = (line for line in told if "share of the frames at which it was steered" in line)
    # The log of the truth has three more frames, still on their way, and the gate may have braked.
    assert float(line.split()[-2]) == pytest.approx(100.0 * share, abs=6.0)
    page = (request.out / "follow.html").read_text(encoding="utf-8")
    assert "share of the frames at which it was steered" in page


@pytest.mark.usefixtures("without_figures")
def test_simulation_ends_where_the_plan_ends(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    told: list[str] = []
    request = SimRequest(out=tmp_path / "out", aim=Aim(plan=plan), seconds=20.0, cage_radius=10.0)
    run_simulation(request, lambda line: told.append(line))
    assert any("the plan is done; holding" in line for line in told)
    with (request.out / TRUTH_CSV).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    # The leg of 2 s counts from the first posture; then it holds, and is shown to hold.
    over_s = next(float(row["time_s"]) for row in rows if row["stage"] == "over")
    assert 2.0 < over_s < 2.6
    assert float(rows[-1]["time_s"]) == pytest.approx(over_s + 5.0, abs=0.1)
    assert float(rows[-1]["along_m"]) > float(rows[0]["along_m"])
    assert abs(float(rows[-1]["range_m"]) - 0.6) < 0.1
    assert rows[-1]["engaged"] == "1"
    assert float(rows[-1]["effort_forward"]) != 0.0


def test_a_vehicle_that_cannot_sway_refuses_to_follow(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    request = SimRequest(out=tmp_path, aim=Aim(plan=plan), vehicle="videoray", seconds=2.0)
    with pytest.raises(OptionError, match="cannot move sideways"):
        run_simulation(request, print)


def test_what_cannot_be_simulated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--seconds 0"):
        SimRequest(out=tmp_path, aim=Aim(), seconds=0.0)
    with pytest.raises(OptionError, match="--cage-radius 1"):
        SimRequest(out=tmp_path, aim=Aim(), cage_radius=1.0)
    with pytest.raises(OptionError, match="--current 9"):
        SimRequest(out=tmp_path, aim=Aim(), current=9.0)
    with pytest.raises(OptionError, match="before the end after 4 s"):
        SimRequest(out=tmp_path, aim=Aim(), seconds=4.0, freeze=4.0)
    with pytest.raises(OptionError, match="add --rendered"):
        SimRequest(out=tmp_path, aim=Aim(), camera="pal")
    with pytest.raises(OptionError, match="leave --range"):
        Aim(plan=tmp_path / "plan.yaml", range=0.5).mission((0.3, 1.0))
    with pytest.raises(OptionError, match="outside the working range"):
        Aim(range=5.0).mission((0.3, 1.0))


def test_command_line_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["follow", "udp://0.0.0.0:5600"]) == 2
    assert "--rig, --mavlink and --gains" in capsys.readouterr().err
    assert main(["follow", "udp://0.0.0.0:5600", "--sim"]) == 2
    assert "SOURCE udp://0.0.0.0:5600: for a vehicle" in capsys.readouterr().err


class Switch:
    """Stands for a pilot that refuses the first time."""

    def __init__(self) -> None:
        self.engaged = False
        self.n_asked = 0

    def engage(self) -> None:
        self.n_asked += 1
        if self.n_asked == 1:
            raise OptionError("pilot: not engaged: the vehicle is disarmed")
        self.engaged = True

    def disengage(self) -> None:
        self.engaged = False


def test_enter_engages_and_gives_back() -> None:
    told: list[str] = []
    pilot = Switch()
    keys = io.StringIO("\n\n\n")
    listen(pilot, keys, lambda line: told.append(line)).join(60.0)
    assert told == ["pilot: not engaged: the vehicle is disarmed", "engaged", "disengaged"]
    assert not pilot.engaged


@pytest.mark.usefixtures("without_figures")
def test_yaw_is_held_where_it_is_asked_for(tmp_path: Path) -> None:
    request = SimRequest(
        out=tmp_path,
        aim=Aim(range=0.6, yaw=math.radians(15.0)),
        seconds=8.0,
        current=0.0,
        waves=0.0,
    )
    run_simulation(request, lambda _: None)
    with (tmp_path / TRUTH_CSV).open(encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    # The scanner's noise of 0.4 degrees, smoothed.
    assert float(last["yaw_deg"]) == pytest.approx(15.0, abs=1.0)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("name", ["bluerov2_heavy", "bluerov2-heavy"])
def test_a_vehicle_has_either_spelling(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tune", name]) == 0
    assert "name: bluerov2_heavy" in capsys.readouterr().out
    simulated = ["follow", "--sim", "--seconds", "1", "-o", str(tmp_path / "out")]
    assert main([*simulated, "--vehicle", name, "--gains", name]) == 0
