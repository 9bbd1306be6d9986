"""What a benchmark set says to whoever opens its folder."""

README = """\
# Range and orientation from laser stripes under water: a benchmark

A camera behind a small dome looks at a net or a wall; three green line lasers beside it draw
stripes. For every frame: how far away is the target, and how is it turned? The pictures are
rendered, so the truth is exact.

## What is here

- `benchmark.yaml`: name and checksum of the set, its dives and their levels of difficulty. `whole:
  false` means that this is a part of the set, whose scores stand for themselves.
- `DIVE/dive.mp4`: the video, H.264. Single pictures: `ffmpeg -i dive.mp4 frame_%04d.png` (ffmpeg
  counts from 1; frames here count from 0).
- `DIVE/rig.yaml`: camera, dome, water and lasers, the same for all dives. Nothing has to be
  calibrated.
- `DIVE/target.yaml`: what may be known of the target beforehand: net or wall, and the net's
  mesh. Say if your system uses it; aqualvs itself does not.
- `DIVE/truth.csv`: the truth, for scoring. A system must not read it.

Levels: clear, turbid, sun, fouled, folded, crowded; and empty, where there is nothing to measure.
The dives of a course (near, far, swing, wall) move alike on every level, and before the same
target, but for what the level does to it.

## Frames of reference and what is asked for

`dome`: origin in the dome's centre, x right, y forward, z up; metres. The target is the plane
n . X = d with |n| = 1 and d > 0.

- range = d, the distance of the dome's centre from the plane
- pitch = atan2(n_z, n_y), positive when the plane's far normal points up
- yaw = atan2(n_x, n_y), positive when it points to the right

The plane meant is the one through the stripe points on the target that the picture truly shows
(least squares). On a net they lie on the front of its twine.

## The rig: how a pixel becomes a ray

`camera` is a pinhole with lens distortion k1 k2 p1 p2 as in OpenCV (`cv2.undistortPoints`); the
centre of the top left pixel is (0, 0); camera axes x right, y down, z forward. A direction
(x, y, z) of the camera is (x, z, -y) in `dome`, then turned by the rotation vector `rotation_deg`
(axis times angle). `position_mm` is the lens in `dome`: it is NOT in the dome's centre, so rays
bend.

The dome is two spheres around the origin, of radius `inner_radius_mm` and `inner_radius_mm +
thickness_mm`. Follow the ray from the lens to the inner sphere, refract it there from `n_air` to
`n_acrylic`, go on to the outer sphere, and refract it from `n_acrylic` to the water's index
(Snell's law in three dimensions). To leave this out costs several percent of the range.

A laser lights the plane normal . X = offset_mm, in `dome` (normals there are made units first;
offsets belong to the unit normal). Where a ray in the water meets a laser's plane is a point of the
target.

## What to write

One CSV for every dive, `RESULTS/DIVE.csv` (or all in one file with a further column `dive`):

    frame,range_m,pitch_deg,yaw_deg
    0,0.3131,6.42,-9.87
    1,0.3204,6.31,-9.02

Frames without an answer are left out, or have `valid` 0. Columns that may be added, in any order:

- `valid`: 1 or 0
- `sigma_range_m`, `sigma_pitch_deg`, `sigma_yaw_deg`: the standard deviations that you claim
- `range_mm` and `sigma_range_mm` in place of the metres

## Scores

    pip install aqualvs
    aqualvs score mine=RESULTS other=OTHER_RESULTS --truth . -o scores

- *available*: share of the frames with at least 40 visible stripe points that have an answer. A
  point is visible where the stripe lifts a pixel by at least 10 of 255 grey levels; a stripe has
  one point in every pixel along it.
- *range*, *pitch*, *yaw*: errors of the answers in those frames: rms, median, 95th percentile,
  maximum.
- *wrong*: answers whose range is off by more than 5 %: to a fish, a wall behind, the water's glow.
- *false*: answers in frames without any visible point.
- *z*: rms of error over claimed sigma; 1 is honest, more is too sure.

## Columns of truth.csv

| column | meaning |
|---|---|
| frame, time_s | from 0 |
| range_m, pitch_deg, yaw_deg | of the plane through the visible stripe points |
| n_visible | visible stripe points on the target |
| n_visible_lasers | lasers with at least five of them |
| residual_mm | largest distance of a visible point from the plane: folds, growth, twine |
| plane_range_m, plane_pitch_deg, plane_yaw_deg | of the target's own plane |

The target's own plane holds the axes of a net's twine, without folds. Without a target all of these
are empty.
"""
"""Written as `README.md` into every set."""
