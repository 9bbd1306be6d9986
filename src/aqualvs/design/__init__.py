"""`aqualvs design`: predicted errors of a camera, a dome and lasers before they are bought.

A design is a rig before calibration: nominal values, mounts of lasers, tolerances. Posture errors
are computed with the rig's camera model, the best angles of the lasers by a search.
"""
