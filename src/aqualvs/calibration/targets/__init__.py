"""Calibration targets: boards, boxes of markers, their files, and how they are printed."""
