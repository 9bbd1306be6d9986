"""`aqualvs design`: what a camera, a dome and lasers would measure, before they are bought.

A design is a rig without calibration: nominal numbers, mounts for lasers, tolerances. Errors of
posture follow from the rig's own camera model; the lasers' angles from a search over them.
"""
