"""Recordings of dives as MCAP files that stay readable however the writing ends."""

from aqualvs.recording.encoding import PictureFormat
from aqualvs.recording.messages import RecordedFrame, RecorderOptions
from aqualvs.recording.recorder import Recorder, RecorderSwitch, Recording
from aqualvs.recording.replay import DiveRecording, is_recording

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
