"""Calibration: targets and their detection, camera, dome, lasers, refractive index of the water.

Functions take what was found in pictures (`targets.targets.View`, stripe points) and a rig, and
return solved rigs with their covariance. `scanning` finds the stripes; `calibrate` joins the two.
"""
