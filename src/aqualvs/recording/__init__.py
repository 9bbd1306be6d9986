"""Recordings of dives as MCAP files that stay readable however the writing ends."""

from aqualvs.recording.encoding import PictureFormat
from aqualvs.recording.messages import RecorderOptions
from aqualvs.recording.recorder import Recorder, RecorderSwitch, Recording
from aqualvs.recording.replay import DiveRecording, RecordedFrame, is_recording

__all__ = [
    "DiveRecording",
    "PictureFormat",
    "RecordedFrame",
    "Recorder",
    "RecorderOptions",
    "RecorderSwitch",
    "Recording",
    "is_recording",
]
