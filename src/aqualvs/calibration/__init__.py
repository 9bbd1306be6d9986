"""Calibration: targets and their detection, camera, dome, lasers, water.

Functions take pictures' findings (`view.View`, stripe pixels) and a rig, and return solved rigs
with their covariance. Finding stripes belongs to `scanning`; `app` joins the two.
"""
