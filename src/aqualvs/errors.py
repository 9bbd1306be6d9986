"""The exception tree of the package.

::

    AqualvsError                what a user can mend; the command line prints it and exits with 2
      RigError                  a rig file, or a rig that cannot exist
      SourceError               a video, image folder, recording or log that cannot be read
      OutputError               a folder or file that cannot be written
      OptionError               an option, or a combination of them, that makes no sense
      CalibrationError          pictures, targets or poses from which nothing can be solved

A refused posture is not an exception but a value, `aqualvs.scanning.posture.Refusal`.
"""


class AqualvsError(Exception):
    """A fault that the user can mend.

    The message is one line that names the file, the value and the remedy.
    """


class RigError(AqualvsError):
    """A rig file that cannot be read, or a rig that cannot exist."""


class SourceError(AqualvsError):
    """A source of frames, or a vehicle's log, that cannot be opened or decoded."""


class OutputError(AqualvsError):
    """An output folder or file that cannot be written."""


class OptionError(AqualvsError):
    """An option, or a combination of options, that makes no sense."""


class CalibrationError(AqualvsError):
    """Pictures, targets or poses from which nothing can be solved."""
