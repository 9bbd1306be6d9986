"""Where frames come from: recordings for `run`, and live feeds."""

from aqualvs.live.sources.base import FrameSource
from aqualvs.live.sources.feed import Feed
from aqualvs.live.sources.images import ImageSource
from aqualvs.live.sources.opening import open_feed, open_source
from aqualvs.live.sources.video import VideoSource

__all__ = ["Feed", "FrameSource", "ImageSource", "VideoSource", "open_feed", "open_source"]
