"""The exceptions that reach a user: each becomes one line on standard error and an exit status.

A message names the file or key, what was found and what was expected.
"""


class SplatpipeError(Exception):
    """Failed while running (exit status 1)."""

    exit_status = 1


class InputError(SplatpipeError):
    """Bad usage, configuration or input (exit status 2): nothing was written."""

    exit_status = 2


class ConfigError(InputError):
    """A configuration file or key is wrong."""


class StoreError(InputError):
    """A scene directory is missing, damaged or of another version."""


class MessageError(SplatpipeError):
    """A message from another rank is malformed."""


class DeviceError(SplatpipeError):
    """A device (OpenGL, MPI) is missing or failed; the message says what to install or set."""


class CodecError(SplatpipeError):
    """Encoded cells are damaged, or what is to be encoded does not suit the codec."""
