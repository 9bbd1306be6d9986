"""Sources of frames and outputs of posture."""
