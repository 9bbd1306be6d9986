"""Imported cameras project as the program does that their file is of.

OpenCV projects itself. The other formulas are written here from their sources, for points one by
one, without code of aqualvs.
"""

import math

import cv2
import numpy as np
import pytest

from aqualvs.calibration_files import read_camera, rig_of_camera
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL

N, LIMIT_PX = 1000, 1e-6
CORE = (817.5, 878.0, 368.9, 281.7)
FX, FY, CX, CY = CORE
FOUR = (-0.126, 0.0827, 0.0006, -0.0004)
FIVE = (*FOUR, -0.021)
EIGHT = (*FIVE, 0.031, -0.012, 0.004)
FISHEYE = (-0.013, 0.0051, -0.0045, 0.0012)


def points(seed=0):
    """Points in front of a camera of 45 degrees to either side, in metres."""
    rng = np.random.default_rng(seed)
    tangents = rng.uniform(-0.45, 0.45, (N, 2))
    depth = rng.uniform(0.2, 3.0, (N, 1))
    return np.hstack([tangents, np.ones((N, 1))]) * depth


def imported(tmp_path, text, name="file.yaml", **given):
    path = tmp_path / name
    path.write_text(text)
    return rig_of_camera(read_camera(path, **given), str(path))


def check(rig, expected):
    # The camera alone: in `cam`, without its nominal mounting.
    found, valid = rig.lens.pixels(points())
    assert valid.all()
    assert len(expected) == N
    assert np.max(np.abs(found - expected)) < LIMIT_PX


def by_opencv(distortion, fisheye=False):
    matrix = np.array([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
    zero, cloud = np.zeros(3), points()[:, None, :]
    values = np.array(distortion, np.float64)
    if fisheye:
        pixels, _ = cv2.fisheye.projectPoints(cloud, zero, zero, matrix, values)
    else:
        pixels, _ = cv2.projectPoints(cloud, zero, zero, matrix, values)
    return pixels.reshape(-1, 2)


# ROS and OpenCV. ----------------------------------------------------------------------------------

ROS_MODELS = {
    "plumb_bob": (FIVE, False),
    "rational_polynomial": (EIGHT, False),
    "equidistant": (FISHEYE, True),
}


def ros_text(model, distortion):
    return f"""image_width: 720
image_height: 576
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [{FX}, 0, {CX}, 0, {FY}, {CY}, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {len(distortion)}
  data: [{", ".join(map(str, distortion))}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [{FX}, 0, {CX}, 0, 0, {FY}, {CY}, 0, 0, 0, 1, 0]
"""


@pytest.mark.parametrize("model", ROS_MODELS)
def test_ros_projects_as_opencv(tmp_path, model):
    distortion, fisheye = ROS_MODELS[model]
    check(imported(tmp_path, ros_text(model, distortion)), by_opencv(distortion, fisheye))


def test_a_printed_camera_info_message_does_too(tmp_path):
    listed = "\n".join(f"- {value}" for value in FIVE)
    matrix = "\n".join(f"- {value}" for value in (FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0))
    text = (
        "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\nheight: 576\nwidth: 720\n"
        f"distortion_model: plumb_bob\nd:\n{listed}\nk:\n{matrix}\nbinning_x: 0\nbinning_y: 0\n"
        "roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n---\n"
    )
    check(imported(tmp_path, text), by_opencv(FIVE))


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [(FOUR, 0), (FIVE, 0), (EIGHT, 0), ((*EIGHT, 0, 0, 0, 0), 0), (FISHEYE, 1)],
)
def test_a_file_storage_projects_as_opencv(tmp_path, suffix, distortion, fisheye):
    path = tmp_path / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("image_width", 720)
    storage.write("image_height", 576)
    storage.write("fisheye_model", fisheye)
    storage.write("camera_matrix", np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array(distortion, np.float64).reshape(-1, 1))
    storage.release()
    rig = rig_of_camera(read_camera(path), str(path))
    check(rig, by_opencv(distortion, bool(fisheye)))


# As OpenCV 2 to 4 write it (samples/cpp/calibration.cpp).
YAML_1_0 = f"""%YAML:1.0
---
calibration_time: "Mon 23 Nov 2026 10:00:00"
image_width: 720
image_height: 576
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {FX}, 0., {CX}, 0., {FY}, {CY}, 0., 0.,
       1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ {", ".join(map(str, FIVE))} ]
avg_reprojection_error: 1.2e-01
"""


def test_a_file_storage_of_older_opencv_projects_as_opencv(tmp_path):
    check(imported(tmp_path, YAML_1_0, "out.yml"), by_opencv(FIVE))


# Kalibr. ------------------------------------------------------------------------------------------


def radtan(x, y, k1, k2, r1, r2):
    """Furgale, Rehder, Siegwart (IROS 2013); aslam_cameras, RadialTangentialDistortion.hpp."""
    mx2, my2, mxy = x * x, y * y, x * y
    rho2 = mx2 + my2
    radial = k1 * rho2 + k2 * rho2 * rho2
    return (
        x + x * radial + 2.0 * r1 * mxy + r2 * (rho2 + 2.0 * mx2),
        y + y * radial + 2.0 * r2 * mxy + r1 * (rho2 + 2.0 * my2),
    )


def equidistant(x, y, k1, k2, k3, k4):
    """Kannala & Brandt (PAMI 2006); aslam_cameras, EquidistantDistortion.hpp."""
    r = math.hypot(x, y)
    theta = math.atan(r)
    t2 = theta * theta
    scaling = theta * (1.0 + k1 * t2 + k2 * t2**2 + k3 * t2**3 + k4 * t2**4) / r
    return x * scaling, y * scaling


KALIBR = {
    "radtan": (radtan, FOUR),
    "equidistant": (equidistant, FISHEYE),
    "equi": (equidistant, FISHEYE),
    "none": (lambda x, y: (x, y), ()),
}


def camchain(model, distortion, name="cam0"):
    return f"""{name}:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [{", ".join(map(str, distortion))}]
  distortion_model: {model}
  intrinsics: [{FX}, {FY}, {CX}, {CY}]
  resolution: [720, 576]
  rostopic: /cam0/image_raw
"""


@pytest.mark.parametrize("model", KALIBR)
def test_kalibr_projects_by_its_formulas(tmp_path, model):
    distort, distortion = KALIBR[model]
    expected = []
    for x, y, z in points():
        u, v = distort(x / z, y / z, *distortion)
        expected.append((FX * u + CX, FY * v + CY))
    check(imported(tmp_path, camchain(model, distortion)), np.array(expected))


# mrcal. -------------------------------------------------------------------------------------------


def mrcal_opencv(x, y, k):
    """mrcal, "Lens models": LENSMODEL_OPENCV4 to 12, in the order k1 k2 p1 p2 k3 k4 k5 k6 s1..."""
    k = [*k, *[0.0] * (12 - len(k))]
    r2 = x * x + y * y
    r4, r6 = r2 * r2, r2**3
    a1, a2, a3 = 2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y
    ratio = (1.0 + k[0] * r2 + k[1] * r4 + k[4] * r6) / (1.0 + k[5] * r2 + k[6] * r4 + k[7] * r6)
    return (
        x * ratio + k[2] * a1 + k[3] * a2 + k[8] * r2 + k[9] * r4,
        y * ratio + k[2] * a3 + k[3] * a1 + k[10] * r2 + k[11] * r4,
    )


def cameramodel(model, values, key="lensmodel"):
    # The odd layout is mrcal's own.
    return f"""# made by a test
{{
    '{key}':  '{model}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ {", ".join(f"{value:.10g}" for value in values)},],

    # extrinsics are rt_fromref
    'extrinsics': [ 2e-2, -3e-1, -1e-2,  1., 2, -3., ],

    'imagersize': [ 720, 576,],
    'optimization_inputs': b'P)h>@6aWAK'
}}
"""


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("LENSMODEL_PINHOLE", ()),
        ("LENSMODEL_OPENCV4", FOUR),
        ("LENSMODEL_OPENCV5", FIVE),
        ("LENSMODEL_OPENCV8", EIGHT),
        ("LENSMODEL_OPENCV12", (*EIGHT, 0.0, 0.0, 0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("key", ["lensmodel", "lens_model"])
def test_mrcal_projects_by_its_formulas(tmp_path, model, distortion, key):
    expected = []
    for x, y, z in points():
        u, v = mrcal_opencv(x / z, y / z, distortion)
        expected.append((FX * u + CX, FY * v + CY))
    text = cameramodel(model, (*CORE, *distortion), key)
    check(imported(tmp_path, text, "cam.cameramodel"), np.array(expected))


# COLMAP. ------------------------------------------------------------------------------------------


def colmap_radial(x, y, p):
    """COLMAP, sensor/models.h: SimpleRadialCameraModel, RadialCameraModel."""
    r2 = x * x + y * y
    radial = sum(k * r2 ** (i + 1) for i, k in enumerate(p))
    return x + x * radial, y + y * radial


def colmap_opencv(x, y, p):
    """COLMAP, sensor/models.h: OpenCVCameraModel and FullOpenCVCameraModel."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*p, *[0.0] * (8 - len(p))]
    u2, v2, uv = x * x, y * y, x * y
    r2 = u2 + v2
    radial = (1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1.0 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    du = x * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u2) - x
    dv = y * radial + 2.0 * p2 * uv + p1 * (r2 + 2.0 * v2) - y
    return x + du, y + dv


COLMAP = {
    "SIMPLE_PINHOLE": (1, colmap_radial, ()),
    "PINHOLE": (2, colmap_radial, ()),
    "SIMPLE_RADIAL": (1, colmap_radial, (-0.05,)),
    "RADIAL": (1, colmap_radial, (-0.05, 0.021)),
    "OPENCV": (2, colmap_opencv, FOUR),
    "FULL_OPENCV": (2, colmap_opencv, EIGHT),
    "OPENCV_FISHEYE": (2, lambda x, y, p: equidistant(x, y, *p), FISHEYE),
}


def cameras_txt(model, core, distortion, port=""):
    values = " ".join(map(str, (*core, *distortion)))
    return (
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n"
        f"1 {model} 720 576 {values}{port}\n"
    )


def colmap_pixel(point, core, distort, distortion):
    """Pixel as OpenCV counts it: COLMAP's centre of the top-left pixel is (0.5, 0.5)."""
    x, y, z = point
    u, v = distort(x / z, y / z, distortion)
    focal = (core[0], core[0]) if len(core) == 3 else core[:2]
    return focal[0] * u + core[-2] - 0.5, focal[1] * v + core[-1] - 0.5


@pytest.mark.parametrize("model", COLMAP)
def test_colmap_projects_by_its_formulas(tmp_path, model):
    n_focal, distort, distortion = COLMAP[model]
    core = (*CORE[:n_focal], CX + 0.5, CY + 0.5)
    expected = [colmap_pixel(point, core, distort, distortion) for point in points()]
    rig = imported(tmp_path, cameras_txt(model, core, distortion), "cameras.txt")
    check(rig, np.array(expected))


# Refractive COLMAP. -------------------------------------------------------------------------------

PORT = (-0.0036, 0.0014, -0.0415, 0.04425, 0.00575, 1.0003, 1.49, 1.3333)
FLAT = (0.06, -0.08, math.sqrt(0.99), 0.012, 0.005, 1.0003, 1.49, 1.3333)


def sphere(origin, direction, centre, radius):
    """Return where a ray from the inside leaves a sphere (RaySphereIntersection, dmax)."""
    away = origin - centre
    half = away @ direction
    return origin + direction * (-half + math.sqrt(half**2 - away @ away + radius**2))


def snell(direction, normal, n_in, n_out):
    """Return the refracted direction (ComputeRefraction); both vectors point outwards."""
    ratio, cosine = n_in / n_out, direction @ normal
    return ratio * direction + (math.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine) * (
        normal
    )


def through_the_dome(direction, depth, port):
    """Return the point at a distance from the lens that a pixel's ray goes through.

    colmap_underwater, sensor/models_refrac.h: DomePort::CamFromImg and CamFromImgPoint.
    """
    centre, (radius, thickness, na, ng, nw) = np.array(port[:3]), port[3:]
    at = sphere(np.zeros(3), direction, centre, radius)
    direction = snell(direction, (at - centre) / radius, na, ng)
    at = sphere(at, direction, centre, radius + thickness)
    direction = snell(direction, (at - centre) / (radius + thickness), ng, nw)
    return sphere(at, direction, np.zeros(3), depth)


def through_the_plane(direction, depth, port):
    """Return the point as `through_the_dome` does; FlatPort::CamFromImg and CamFromImgPoint."""
    normal, (distance, thickness, na, ng, nw) = np.array(port[:3]), port[3:]
    at = direction * distance / (direction @ normal)
    direction = snell(direction, normal, na, ng)
    at = at + direction * thickness / (direction @ normal)
    return sphere(at, snell(direction, normal, ng, nw), np.zeros(3), depth)


@pytest.mark.parametrize(
    ("word", "through", "values"),
    [
        ("DOMEPORT", through_the_dome, PORT),
        ("REFRAC DOMEPORT", through_the_dome, PORT),
        ("FLATPORT", through_the_plane, FLAT),
    ],
)
def test_refractive_colmap_projects_by_its_formulas(tmp_path, word, through, values):
    core = (*CORE[:2], CX + 0.5, CY + 0.5)
    port = f" {word} {' '.join(map(str, values))}"
    rig = imported(tmp_path, cameras_txt("OPENCV", core, FOUR, port), "cameras.txt")
    cloud, pixels = [], []
    for direction in points():
        depth = float(np.linalg.norm(direction)) + 0.2
        unit = direction / np.linalg.norm(direction)
        cloud.append(through(unit, depth, values))
        pixels.append(colmap_pixel(direction, core, colmap_opencv, FOUR))
    found, valid = rig.camera().project(rig.dome_from_cam.apply(np.array(cloud)))
    assert valid.all()
    assert np.max(np.abs(found - np.array(pixels))) < LIMIT_PX
    # Without refraction the same points are pixels away: the test can fail.
    bare, _ = rig.bare_camera().project(rig.dome_from_cam.apply(np.array(cloud)))
    assert np.max(np.abs(bare - np.array(pixels))) > 1.0


def test_the_dome_is_where_the_file_says(tmp_path):
    core = (*CORE[:2], CX + 0.5, CY + 0.5)
    text = cameras_txt("PINHOLE", core, (), f" DOMEPORT {' '.join(map(str, PORT))}")
    rig = imported(tmp_path, text, "cameras.txt")
    centre_in_cam = rig.dome_from_cam.inverse().apply(np.zeros(3))
    np.testing.assert_allclose(centre_in_cam, PORT[:3], atol=1e-12)
    assert isinstance(rig.dome_from_cam, SE3)
    np.testing.assert_array_equal(rig.dome_from_cam.rotation, DOME_FROM_CAM_NOMINAL)
    assert (rig.n_air, rig.dome.n_acrylic, rig.n_water) == PORT[5:]
    assert (rig.dome.inner_radius, rig.dome.thickness) == PORT[3:5]
