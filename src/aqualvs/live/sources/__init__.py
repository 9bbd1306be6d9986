"""Where frames come from: video files and streams, folders of images."""

from aqualvs.live.sources.base import FrameSource
from aqualvs.live.sources.images import ImageSource
from aqualvs.live.sources.opening import open_source
from aqualvs.live.sources.video import VideoSource

__all__ = ["FrameSource", "ImageSource", "VideoSource", "open_source"]
