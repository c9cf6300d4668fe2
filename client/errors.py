"""Errors a user can cause; each message is one line that says what was wrong and what to do."""


class UserError(Exception):
    """Base of all of them; the command line prints the message and ends with a status that is not 0."""


class SourceError(UserError):
    """A source cannot be opened or a frame of it cannot be read."""


class ObjectError(UserError):
    """A virtual object's file or its place is unusable."""


class OutputError(UserError):
    """Results cannot be written."""


class RunError(UserError):
    """The pipeline refused what it was given."""


class OptionError(UserError):
    """An option of the command line has a value that cannot be used, or asks for what is not built."""
