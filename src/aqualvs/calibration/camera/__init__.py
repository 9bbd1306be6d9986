"""Calibration of the camera's intrinsics in air."""
