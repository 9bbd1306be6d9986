"""From a frame to stripes, points and posture."""
