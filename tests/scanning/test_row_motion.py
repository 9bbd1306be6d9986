"""Postures of a rolling shutter are those of the picture's middle."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig_covariance import posture_by_plane
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.scanner import Scanner
from aqualvs.scanning import row_motion
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.row_motion import RowMotion, motion_beside
from aqualvs.scanning.scan import Frame, GyroRates, Scan, ScanPoints, planes_of_image
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene, Wall

START = np.array([0.57, np.deg2rad(2.0), np.deg2rad(-3.0)])
RATES = np.array([0.25, np.deg2rad(18.0), np.deg2rad(-15.0)])
STEP_S = 0.04
N = 5


def rig_with(shutter):
    """The example rig at half its resolution, for speed."""
    rig = example_rig()
    lens = replace(rig.lens, fx=408.5, fy=439.0, cx=184.25, cy=140.75)
    return replace(rig, size_px=(360, 288), lens=lens, shutter=shutter)


ROLLING = rig_with(Shutter(kind=ShutterKind.ROLLING, readout=0.02))


def truth(i):
    return START + RATES * STEP_S * (i - 2)


def scene_at(t):
    pose = dome_from_target(*(truth(0) + RATES * t))
    return Scene(dome_from_scene=pose, walls=(Wall(),), target="wall")


@pytest.fixture(scope="module")
def frames():
    """Consecutive pictures of a wall before a vehicle that turns and backs off."""
    eye, found = Renderer(ROLLING), []
    for i in range(N):
        t = STEP_S * i
        image = eye.take(scene_at, t, np.random.default_rng(i)).image
        found.append(Frame(i, t, *planes_of_image(np.ascontiguousarray(image[:, :, ::-1]))))
    return found


@pytest.fixture(scope="module")
def scans(frames):
    scanner = Scanner(ROLLING)
    return [scanner.scan(frame)[1] for frame in frames]


def error(scan, i):
    """Error of a posture: range in permille, angles in degrees."""
    return (scan.posture.numbers - truth(i)) / [1e-3 * truth(i)[0], *2 * [np.pi / 180.0]]


def off_plane(scan):
    """Distances of the points of the posture from the true wall at the picture's middle."""
    normal = scene_at(scan.time_s).dome_from_scene.rotation[:, 1]
    used = scan.points.points_in_dome[scan.points.used]
    return used @ normal - truth(scan.index)[0]


def test_a_posture_is_that_of_the_pictures_middle(scans):
    assert abs(error(scans[2], 2)[1]) > 0.5
    found = RowMotion(ROLLING).correct(scans[2], [*scans[:2], *scans[3:]])
    assert np.all(np.abs(error(found, 2)) < [1.0, 0.15, 0.15])
    sigma = np.sqrt(np.diag(found.posture.covariance))
    assert np.all(np.abs(found.posture.numbers - truth(2)) < 3.0 * sigma)
    assert found.posture.by_motion is None


def test_the_sigma_of_a_frame_alone_includes_how_vehicles_move(frames, scans):
    found = Scanner(ROLLING).process(frames[2]).posture
    assert found.by_motion is None
    off = np.abs(found.numbers - truth(2))
    assert np.any(off > 3.0 * np.sqrt(np.diag(scans[2].posture.covariance)))
    assert np.all(off < 3.0 * np.sqrt(np.diag(found.covariance)))


def test_a_picture_turned_upside_down_has_a_negative_readout(frames, scans):
    lens, pose = ROLLING.lens, ROLLING.dome_from_cam
    k1, k2, p1, p2 = lens.distortion[:4]
    width, height = ROLLING.size_px
    turned_lens = replace(
        lens,
        cx=width - 1.0 - lens.cx,
        cy=height - 1.0 - lens.cy,
        distortion=(k1, k2, -p1, -p2, *lens.distortion[4:]),
    )
    rig = replace(
        ROLLING,
        lens=turned_lens,
        dome_from_cam=SE3(pose.rotation @ np.diag([-1.0, -1.0, 1.0]), pose.translation),
        shutter=replace(ROLLING.shutter, readout=-ROLLING.shutter.readout),
    )
    scanner = Scanner(rig)

    def upside_down(frame):
        luma, *chroma = (
            np.ascontiguousarray(one[::-1, ::-1]) for one in (frame.luma, *frame.chroma)
        )
        return scanner.scan(replace(frame, luma=luma, chroma=tuple(chroma)))[1]

    found = [upside_down(frame) for frame in frames]
    correct = RowMotion(rig).correct(found[2], [*found[:2], *found[3:]])
    upright = RowMotion(ROLLING).correct(scans[2], [*scans[:2], *scans[3:]])
    # Which of the points are used begins at another corner of the picture.
    off = correct.posture.numbers - upright.posture.numbers
    assert np.all(np.abs(off) < 0.5 * np.sqrt(np.diag(upright.posture.covariance)))
    assert np.all(np.abs(error(correct, 2)) < [1.0, 0.15, 0.15])


def test_a_wall_that_leans_for_its_motion_is_no_nearer(scans):
    """It leans by 1.1 degrees, which is 0.2 permille of the range."""
    motion = RowMotion(ROLLING)
    found = [motion.correct(scan, [one for one in scans if one is not scan]) for scan in scans]
    errors = np.array([error(one, i) for i, one in enumerate(found)])
    assert np.all(np.abs(errors.mean(axis=0)) < [0.06, 0.04, 0.04])


def test_the_rates_by_one_frame_leave_no_trace(frames, scans, monkeypatch):
    fitted = row_motion._fit_rates

    def other_rates(points, sigma, times, m):
        m, m_rate = fitted(points, sigma, times, m)
        # 0.3 m/s towards the wall.
        return m, m_rate + 0.3 / truth(2)[0] * m

    monkeypatch.setattr(row_motion, "_fit_rates", other_rates)
    found = Scanner(ROLLING).scan(frames[2])[1].posture
    assert abs(found.by_motion[1, 0] * 0.3) > np.deg2rad(1.0)
    off = (found.numbers - scans[2].posture.numbers) / [1e-3 * truth(2)[0], *2 * [np.pi / 180.0]]
    assert np.all(np.abs(off) < [0.03, 0.006, 0.006])


def test_a_posture_is_that_of_a_vehicle_that_brakes():
    """Points of an even grid show the mean of their times, without noise."""
    readout, exposure = 0.03, 0.06
    rig = rig_with(Shutter(kind=ShutterKind.ROLLING, readout=readout, exposure=exposure))
    accelerations, jerks = np.array([0.6, 0.5, -0.4]), np.array([1.0, 2.0, -1.0])

    def plane(t):
        distance, pitch, yaw = START + RATES * t + accelerations * t**2 / 2 + jerks * t**3 / 6
        normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
        return normal / np.linalg.norm(normal) / distance

    x, z = (one.ravel() for one in np.meshgrid([-0.3, 0.1, 0.25], np.linspace(0.3, -0.3, 51)))
    times = np.repeat(np.linspace(-0.5, 0.5, 51) * readout, 3)[:, None]
    within = np.linspace(-0.5, 0.5, 401) * exposure

    def scan(i, middle):
        shown = [
            np.mean([plane(middle + t + one) for one in within], axis=0) for t in times[::3, 0]
        ]
        rays = np.column_stack([x, np.ones(len(x)), z])
        points = rays / np.sum(rays * np.repeat(shown, 3, axis=0), axis=1)[:, None]
        fit = np.linalg.solve(points.T @ points, points.T)
        m = fit.sum(axis=1)
        by_m = posture_by_plane(m)
        by_motion = [
            by_m @ fit @ (points * share) @ np.linalg.inv(by_m)
            for share in (times, 0.5 * (times**2 + exposure**2 / 12.0))
        ]
        posture = Posture(
            range=1.0 / np.linalg.norm(m),
            pitch=np.arctan2(m[2], m[1]),
            yaw=np.arctan2(m[0], m[1]),
            covariance=1e-10 * np.eye(3),
            normal_in_dome=m / np.linalg.norm(m),
            slant_range=0.6,
            nearest=0.6,
            n_points=len(points),
            rms=0.0,
            by_motion=np.hstack(by_motion),
        )
        return Scan(i, middle, posture, ScanPoints.none(), 1.33)

    lone = scan(0, 0.0)
    found = RowMotion(rig).correct(lone, [scan(i, 0.1 * i) for i in (-2, -1, 1, 2)]).posture
    assert np.all(np.abs(found.numbers - START) < [1e-5, 1e-4, 1e-5])
    # As exposed it is off by 1.3 degrees, and by the mean of a motion that brakes.
    assert np.all(np.abs(lone.posture.numbers - START) > [2e-4, 2e-2, 5e-5])


@pytest.mark.parametrize("beside", [[0, 1], [3, 4], [3]])
def test_frames_of_one_side_are_enough(scans, beside):
    found = RowMotion(ROLLING).correct(scans[2], [scans[i] for i in beside])
    assert np.all(np.abs(error(found, 2)) < [1.0, 0.2, 0.15])


def test_a_frame_alone_stays_and_says_how_far_it_may_be_off(scans):
    far = replace(scans[4], time_s=9.0)
    lost = Scan(3, 0.12, Refusal(Reason.CORRUPT_FRAME), ScanPoints.none(), 1.33)
    found = RowMotion(ROLLING).correct(scans[2], [lost, far])
    sigma = np.sqrt(np.diag(found.posture.covariance))
    # Nearly all of it is pitch by the change of range.
    assert sigma[1] > 10.0 * np.sqrt(scans[2].posture.covariance[1, 1])
    assert np.all(np.abs(found.posture.numbers - truth(2)) < 3.0 * sigma)
    assert RowMotion(ROLLING).correct(lost, scans).posture is lost.posture


@pytest.mark.parametrize(
    ("exposure", "reason", "expected"),
    [
        (0.15, Reason.NOT_A_PLANE, Reason.BLURRED),
        (0.15, Reason.OUT_OF_RANGE, Reason.OUT_OF_RANGE),
        (0.04, Reason.NOT_A_PLANE, Reason.NOT_A_PLANE),
    ],
)
def test_a_refusal_names_the_blur_that_explains_it(scans, exposure, reason, expected):
    rig = rig_with(Shutter(exposure=exposure))
    refused = replace(scans[2], posture=Refusal(reason, "no plane"))
    found = RowMotion(rig).correct(refused, [scans[1], scans[3]]).posture
    # 23 degrees/s.
    assert found.reason is expected
    assert found.detail == (
        "turned by 3.5 deg in 150 ms of exposure: no plane"
        if expected is Reason.BLURRED
        else "no plane"
    )
    alone = RowMotion(rig).correct(refused, [scans[1]]).posture
    assert alone.reason is reason


def test_a_frame_that_shows_another_surface_tells_nothing(scans):
    wrong = replace(scans[1], posture=replace(scans[1].posture, range=scans[1].posture.range + 0.3))
    motion = RowMotion(ROLLING)
    expected = motion.correct(scans[2], [scans[3]]).posture
    found = motion.correct(scans[2], [wrong, scans[3]]).posture
    assert np.array_equal(found.numbers, expected.numbers)


def test_points_move_to_where_they_are_at_the_middle(scans):
    found = RowMotion(ROLLING).correct(scans[2], [scans[1], scans[3]])
    assert np.std(off_plane(found)) < 0.75 * np.std(off_plane(scans[2]))
    assert abs(off_plane(found).mean()) < 0.3e-3
    assert np.array_equal(found.points.pixels, scans[2].points.pixels)
    nearest = np.linalg.norm(found.points.points_in_dome[found.points.used], axis=1).min()
    assert found.posture.nearest == nearest


def test_motion_is_no_scatter(scans):
    """Sigma is about that of a picture taken at once: the wall's warp is not in it."""
    rig = rig_with(AT_ONCE)
    image = Renderer(rig).render(scene_at(2 * STEP_S), 0.0, np.random.default_rng(2)).image
    frame = Frame(0, 0.0, *planes_of_image(np.ascontiguousarray(image[:, :, ::-1])))
    still = Scanner(rig).process(frame).posture
    assert isinstance(still, Posture)
    assert still.by_motion is None
    ratio = np.diag(scans[2].posture.covariance) / np.diag(still.covariance)
    assert np.all(ratio < 1.5**2)


def turning_at(t, sigma_deg_s=1.0):
    """How a vehicle turns at a time, from the poses of a wall that stands still."""
    step = 1e-4
    before, after = (scene_at(t + s).dome_from_scene.rotation for s in (-step, step))
    # The wall turns by -w x.
    spin = -(after - before) / (2.0 * step) @ scene_at(t).dome_from_scene.rotation.T
    return GyroRates(np.array([spin[2, 1], spin[0, 2], spin[1, 0]]), np.deg2rad(sigma_deg_s))


def test_gyros_tell_the_rates_of_pitch_and_yaw(scans):
    alone = scans[2]
    turning = turning_at(2 * STEP_S, 0.01)
    motion, covariance = motion_beside(replace(alone, turning=turning), [])
    assert motion[1:3] == pytest.approx(RATES[1:], abs=np.deg2rad(0.1))
    assert np.all(np.sqrt(np.diag(covariance)[1:3]) < np.deg2rad(0.02))
    # They tell nothing of how the range changes.
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.3, rel=0.01)


def test_gyros_help_a_lone_frame(scans):
    motion, turning = RowMotion(ROLLING), turning_at(2 * STEP_S, 5.0)
    without = motion.correct(scans[2], []).posture
    found = motion.correct(replace(scans[2], turning=turning), []).posture
    # Of the yaw, which the change of range leaves alone.
    assert abs(found.yaw - truth(2)[2]) < 0.7 * abs(without.yaw - truth(2)[2])
    assert found.covariance[2, 2] < 0.7**2 * without.covariance[2, 2]
    assert abs(found.yaw - truth(2)[2]) < 3.0 * np.sqrt(found.covariance[2, 2])


def test_gyros_that_contradict_the_frames_beside_count_for_nothing(scans):
    motion, beside = RowMotion(ROLLING), [scans[1], scans[3]]
    turning = turning_at(2 * STEP_S)
    wrong = replace(scans[2], turning=replace(turning, rates=-turning.rates))
    expected = motion.correct(scans[2], beside).posture
    assert np.array_equal(motion.correct(wrong, beside).posture.numbers, expected.numbers)
    right = motion.correct(replace(scans[2], turning=turning), beside).posture
    assert not np.array_equal(right.numbers, expected.numbers)
    assert right.numbers == pytest.approx(expected.numbers, abs=1e-3)
