"""Sources of frames: recordings for `run`, and live feeds."""

from aqualvs.sources.base import Feed, FrameSource
from aqualvs.sources.images import ImageSource
from aqualvs.sources.opening import open_feed, open_source
from aqualvs.sources.video import VideoSource

__all__ = ["Feed", "FrameSource", "ImageSource", "VideoSource", "open_feed", "open_source"]
