"""A simulated vehicle under efforts: signs, loops, limits, delays and what it tells."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.control.tune import facts_of, shaping_of_model
from aqualvs.control.vehicle import Effort
from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.vehicle.dynamics import mix_inputs, pack_pilot, thrust_of
from aqualvs.simulation.vehicle.models import (
    BLUEROV2,
    BLUEROV2_HEAVY,
    VEHICLES,
    VIDEORAY,
    StickInput,
    ThrustCurve,
    VehicleModel,
)
from aqualvs.simulation.vehicle.vehicle import SensorErrors, Sensors, SimulatedVehicle
from aqualvs.simulation.vehicle.water_motion import WaterMotion, Waves

MODELS = pytest.mark.parametrize("model", VEHICLES.values(), ids=VEHICLES)
VECTORED = pytest.mark.parametrize("model", [BLUEROV2_HEAVY, BLUEROV2], ids=["heavy", "standard"])
FRAME = 0.04


def vehicle(
    model: VehicleModel, *, heading: float = 0.0, water: WaterMotion | None = None, **options: float
) -> SimulatedVehicle:
    pose = SE3.from_rotvec([0.0, 0.0, heading], [0.0, 0.0, 6.0])
    rng = np.random.default_rng(1)
    return SimulatedVehicle(model, water or WaterMotion(), rng, pose, **options)


def run(one: SimulatedVehicle, effort: Effort, seconds: float) -> None:
    """Send efforts as a link does, with the dead zones of the sticks taken out."""
    sticks = shaping_of_model(one.model).position(effort)
    for _ in range(round(seconds / FRAME)):
        one.step(sticks, FRAME)


@MODELS
def test_efforts_move_where_they_say(model: VehicleModel) -> None:
    start = vehicle(model).pose.translation
    for effort, axis in ((Effort(forward=0.3), 0), (Effort(right=0.3), 1), (Effort(down=0.8), 2)):
        if axis == 1 and model is VIDEORAY:
            continue
        one = vehicle(model)
        run(one, effort, 3.0)
        moved = one.pose.translation - start
        assert moved[axis] > 0.1, effort
        # The others stay: depth hold takes some centimetres up that pitch and trim cost.
        assert np.abs(np.delete(moved, axis)).max() < 0.1, effort


@MODELS
def test_yaw_turns_clockwise_from_above(model: VehicleModel) -> None:
    one = vehicle(model)
    run(one, Effort(yaw=0.3), 1.5)
    assert one.heading > 0.1
    assert one.turning[2] > 0.0
    # Forward was north; clockwise from above turns it to the east.
    assert one.pose.rotation[1, 0] > 0.1


def test_right_is_east_when_heading_north_and_dome_looks_ahead() -> None:
    one = vehicle(BLUEROV2_HEAVY)
    assert one.dome_pose.rotate([0.0, 1.0, 0.0]) == pytest.approx([1.0, 0.0, 0.0])
    assert one.dome_pose.rotate([1.0, 0.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])
    assert one.dome_pose.translation == pytest.approx([0.20, 0.0, 6.0])


def test_no_thruster_no_sway() -> None:
    one = vehicle(VIDEORAY)
    run(one, Effort(right=1.0), 2.0)
    assert one.velocity[1] == pytest.approx(0.0, abs=1e-9)


@MODELS
def test_turning_rate_reaches_what_is_asked(model: VehicleModel) -> None:
    one = vehicle(model)
    sticks = shaping_of_model(model).position(Effort(yaw=0.2))
    asked = 0.2 * facts_of(model).turning_rate
    rates = []
    for _ in range(200):
        one.step(sticks, FRAME)
        rates.append(one.turning[2])
    # There within a second; a few percent too fast until heading and target agree again.
    assert rates[25] > 0.8 * asked
    assert np.mean(rates[-25:]) == pytest.approx(asked, rel=0.08)
    assert max(rates) < 1.3 * asked
    left = one.heading
    run(one, Effort(), 10.0)
    # It coasts some way, because the thrusters' dead band is wide, and comes back as slowly.
    assert abs(one.turning[2]) < math.radians(2.5)
    assert 0.0 < one.heading - left < math.radians(25.0)


@MODELS
def test_holds_depth_and_heading(model: VehicleModel) -> None:
    one = vehicle(model, heading=1.0)
    run(one, Effort(), 20.0)
    assert one.pose.translation[2] == pytest.approx(6.0, abs=0.03)
    # The thrusters' dead band is some degrees of heading wide.
    assert one.heading == pytest.approx(1.0, abs=math.radians(5.0))


def test_holds_depth_after_a_descent() -> None:
    one = vehicle(BLUEROV2_HEAVY)
    run(one, Effort(down=0.8), 4.0)
    run(one, Effort(), 8.0)
    there = one.pose.translation[2]
    assert there > 6.3
    run(one, Effort(), 8.0)
    assert one.pose.translation[2] == pytest.approx(there, abs=0.02)


@VECTORED
def test_holds_roll_and_pitch_in_waves(model: VehicleModel) -> None:
    water = WaterMotion(current=(0.2, 0.2, 0.0), waves=Waves(amplitude=0.2, n=5), seed=4)
    one = vehicle(model, water=water)
    worst = 0.0
    for _ in range(500):
        one.step(Effort(), FRAME)
        worst = max(worst, float(np.abs(one.pose.rotation[2, :2]).max()))
    assert worst < math.radians(10.0)


@VECTORED
@pytest.mark.parametrize("part", ["forward", "right", "yaw"])
def test_limits_are_symmetric(model: VehicleModel, part: str) -> None:
    # Two thrusters run ahead and two in reverse either way, so that 4.5 against 3.5 kgf evens out.
    # The neutral vehicle has nothing to trim; 1 s is before pitch and sway set in.
    still = replace(model, buoyancy=model.weight)
    reach = []
    for sign in (1.0, -1.0):
        one = vehicle(still)
        run(one, Effort(**{part: sign}), 1.0)
        state = {"forward": one.velocity[0], "right": one.velocity[1], "yaw": one.turning[2]}
        reach.append(state[part])
    assert reach[0] > 0.1
    assert reach[1] == pytest.approx(-reach[0], rel=1e-2)


def test_saturation_keeps_the_mix() -> None:
    pilot = pack_pilot(BLUEROV2_HEAVY)

    def thrust(command: float) -> float:
        return thrust_of(command, pilot.curve)

    # Forward 1 and right 0.5 ask 1.5 of two motors: all four are scaled.
    pilot.inputs[:] = [0.0, 0.0, 0.0, 0.0, 1.0, 0.5]
    mix_inputs(pilot)
    level = [thrust(-1 / 3), thrust(-1.0), thrust(1.0), thrust(1 / 3)]
    assert pilot.wanted[:4] == pytest.approx(level)
    assert pilot.wanted[4:] == pytest.approx(0.0)
    # The upright ones are a group of their own.
    pilot.inputs[:] = [0.5, 0.0, 0.0, 1.0, 0.2, 0.0]
    mix_inputs(pilot)
    assert pilot.wanted[:4] == pytest.approx([thrust(-0.2)] * 2 + [thrust(0.2)] * 2)
    mix = BLUEROV2_HEAVY.mixing()[4:]
    shares = (mix[:, 3] + 0.5 * mix[:, 0]) / 1.5
    assert pilot.wanted[4:] == pytest.approx([thrust(share) for share in shares])
    assert np.abs(shares).max() == pytest.approx(1.0)


def test_dead_zones_of_the_sticks() -> None:
    """Positions of the sticks themselves, without a link that takes the dead zones out."""
    sticks = BLUEROV2_HEAVY.sticks
    one = vehicle(BLUEROV2_HEAVY, heading=0.5)
    for _ in range(100):
        one.step(Effort(yaw=0.09, down=0.18), FRAME)
    assert one.heading == pytest.approx(0.5, abs=math.radians(5.0))
    assert one.pose.translation[2] == pytest.approx(6.0, abs=0.03)
    for _ in range(125):
        one.step(Effort(yaw=0.3), FRAME)
    # 60 µs of the stick at this gain, 20 of them in the dead zone.
    asked = sticks.turning_rate * 40.0 / 380.0
    assert one.turning[2] == pytest.approx(asked, rel=0.1)
    # ArduSub: (200 - 20) of (400 - 20) µs past the dead zone; (740 - 530) of (1000 - 530) up.
    facts = facts_of(BLUEROV2_HEAVY)
    assert facts.turning_rate == pytest.approx(math.radians(151.875) * 180.0 / 380.0, rel=1e-3)
    assert facts.climb_rate == pytest.approx(0.5 * 210.0 / 470.0, rel=0.01)


def test_latency_delays_an_effort_exactly() -> None:
    late, prompt = vehicle(BLUEROV2, latency=0.13), vehicle(BLUEROV2)
    late.step(Effort(forward=0.5), 0.13)
    prompt.step(Effort(), 0.13)
    assert late.thrusts == pytest.approx(prompt.thrusts, abs=1e-9)
    late.step(Effort(forward=0.5), 0.1)
    prompt.step(Effort(forward=0.5), 0.1)
    assert late.thrusts == pytest.approx(prompt.thrusts, abs=1e-9)
    assert np.abs(late.thrusts).max() > 1.0


def test_effort_lapses() -> None:
    one = vehicle(BLUEROV2, lapse=0.5)
    run(one, Effort(forward=0.5), 1.0)
    one.step(None, 0.4)
    assert not one.lapsed
    pushed = np.abs(one.thrusts[:4]).min()
    assert pushed > 1.0
    one.step(None, 0.6)
    assert one.lapsed
    # Half a second later, five time constants of the thrusters.
    assert np.abs(one.thrusts[:4]).max() < 0.1 * pushed
    one.step(Effort(forward=0.5), 0.4)
    assert not one.lapsed
    assert np.abs(one.thrusts[:4]).min() > 0.5 * pushed


def test_disarmed_it_floats_and_a_pilots_vehicle_ignores_us() -> None:
    one = vehicle(BLUEROV2)
    one.armed = False
    run(one, Effort(forward=1.0), 1.0)
    assert one.thrusts == pytest.approx(0.0)
    other = vehicle(BLUEROV2)
    other.obeys = False
    run(other, Effort(forward=1.0), 1.0)
    assert np.abs(other.velocity[0]) < 0.01


def test_long_and_short_steps_agree() -> None:
    water = WaterMotion(current=(0.1, 0.2, 0.0), waves=Waves(amplitude=0.1))
    fine, coarse = vehicle(BLUEROV2, water=water), vehicle(BLUEROV2, water=water)
    for _ in range(50):
        fine.step(Effort(forward=0.2, yaw=0.1), FRAME)
    coarse.step(Effort(forward=0.2, yaw=0.1), 2.0)
    assert fine.pose.translation == pytest.approx(coarse.pose.translation, abs=1e-7)
    assert fine.heading == pytest.approx(coarse.heading, abs=1e-7)
    assert fine.time_s == pytest.approx(2.0)


def test_same_seed_same_dive() -> None:
    told = []
    for _ in range(2):
        one = vehicle(VIDEORAY, water=WaterMotion(wander=0.05, waves=Waves(amplitude=0.1, n=4)))
        run(one, Effort(forward=0.4, yaw=-0.1), 2.0)
        told.append((one.telemetry(), tuple(one.pose.translation)))
    assert told[0] == told[1]


def test_sensors_are_as_wrong_as_stated() -> None:
    kinds = Sensors(
        depth=SensorErrors(noise=0.02, bias=0.5, rate=50.0),
        heading=SensorErrors(noise=0.01, wander=0.1, wander_time=0.5, rate=50.0),
        tilt=SensorErrors(),
    )
    rng = np.random.default_rng(7)
    pose = SE3.from_rotvec([0.0, 0.0, 0.3], [0.0, 0.0, 6.0])
    one = SimulatedVehicle(BLUEROV2_HEAVY, WaterMotion(), rng, pose, sensors=kinds)
    depth, heading, tilt = [], [], []
    for _ in range(2000):
        one.step(None, 0.02)
        told = one.telemetry()
        depth.append(told.depth - one.pose.translation[2])
        heading.append(told.heading - one.heading)
        tilt.append(told.roll)
    # 2000 independent readings fix a standard deviation to 1.6 %, a mean to 0.5 mm.
    assert np.mean(depth) == pytest.approx(0.5, abs=0.003)
    assert np.std(depth) == pytest.approx(0.02, rel=0.1)
    # 80 correlation times: to 8 %; three of those.
    assert np.std(heading) == pytest.approx(math.hypot(0.1, 0.01), rel=0.25)
    assert np.ptp(tilt) < 0.01


def test_sensors_read_at_their_rate() -> None:
    one = vehicle(BLUEROV2)
    depths = []
    for _ in range(100):
        one.step(None, 0.02)
        depths.append(one.telemetry().depth)
    # 10 a second for 2 s.
    assert len(set(depths)) == pytest.approx(20, abs=1)


def test_faults_are_refused() -> None:
    one = vehicle(BLUEROV2)
    with pytest.raises(OptionError, match="positive"):
        one.step(Effort(), 0.0)
    with pytest.raises(OptionError, match="number"):
        one.step(Effort(yaw=math.nan), 0.1)
    with pytest.raises(OptionError, match="latency"):
        vehicle(BLUEROV2, latency=-1.0)
    with pytest.raises(OptionError, match="gain"):
        StickInput(gain=0.0)
    with pytest.raises(OptionError, match="factors"):
        BLUEROV2.scaled(mass=0.0)


def test_thrust_curve_is_the_t200s() -> None:
    # Blue Robotics' chart at 12 V, as fractions of the greatest thrust: PWM 1672, 1765 and 1840
    # give 1, 2, 3 of 3.71 kgf; 1302 and 1194 give 1 and 2 of 2.92 kgf.
    curve = np.array([1.0, 1.0, ThrustCurve().dead_band, ThrustCurve().linear])
    chart = {172: 0.27, 265: 0.54, 340: 0.81, -198: -0.342, -306: -0.685}
    for pwm, share in chart.items():
        assert thrust_of(pwm / 400.0, curve) == pytest.approx(share, abs=0.03)
    assert thrust_of(0.06, curve) == 0.0
    assert thrust_of(-2.0, curve) == -1.0
