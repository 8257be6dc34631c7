"""The exception a user is meant to read."""


class CaphyError(Exception):
    """Input or state that the user can put right.

    The message says what must hold, what was got, where (file, frame, joint), and what to do. The command line
    prints it without a traceback and exits with status 2; the service answers it as a 4xx.
    """


class TooSharp(CaphyError):
    """A garment's cut that turns too sharply for edges as long as they were asked for."""


class Diverged(CaphyError):
    """A simulation whose cloth flies apart under its physics."""


class EffectFailed(CaphyError):
    """A user's own effect raised an error."""
