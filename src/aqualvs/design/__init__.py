"""`aqualvs design`: predicted errors of a camera, a dome and lasers before they are bought.

A design is a rig without calibration: nominal numbers, mounts for lasers, tolerances. Errors of
posture follow from the rig's own camera model; the lasers' angles from a search over them.
"""
