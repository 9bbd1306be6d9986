"""Recording of dives as MCAP files that are readable whenever the writing ends."""

from aqualvs.live.recorder.pictures import PictureFormat
from aqualvs.live.recorder.recorder import Recorder
from aqualvs.live.recorder.recording import Recording
from aqualvs.live.recorder.replay import DiveRecording, RecordedFrame, is_recording
from aqualvs.live.recorder.sample_encoder import RecorderOptions
from aqualvs.live.recorder.switch import RecorderSwitch

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
