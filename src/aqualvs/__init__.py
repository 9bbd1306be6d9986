"""Underwater laser vision: posture to a net or wall from a camera behind a dome and line lasers."""

import os

__version__ = "0.1.0"

# Pixels of a picture that OpenCV decodes, read when it is imported: a file of a few kilobytes can
# claim 60,000 x 60,000. The largest cameras have 150 million.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(160_000_000))
