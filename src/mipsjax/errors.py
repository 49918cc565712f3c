"""What can go wrong for a user, and the exit code of the program for each.

The message of every error is one line that says what is wrong and how to mend it.
"""


class MipsjaxError(Exception):
    """Base of all errors a user can cause or mend."""

    exit_code = 1


class ConfigError(MipsjaxError):
    """An option, preset or config file is wrong."""

    exit_code = 2


class InputError(MipsjaxError):
    """The sequence cannot be used."""

    exit_code = 3


class TrackingLostError(MipsjaxError):
    """Tracking was lost and not recovered; results up to then were written."""

    exit_code = 4


class OutputError(MipsjaxError):
    """The output cannot be written."""

    exit_code = 5
