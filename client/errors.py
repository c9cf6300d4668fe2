"""Errors that a user can cause; each message is one line that says what was wrong and what to do."""

OWN_PACKAGES = {"client", "server", "protocol"}
"""Errors of classes in them have a message for the user."""


class UserError(Exception):
    """Base class; the command line prints the message and exits with a status other than 0."""


class SourceError(UserError):
    """A source cannot be opened or a frame of it cannot be read."""


class ObjectError(UserError):
    """The file or the placement of a virtual object is invalid."""


class OutputError(UserError):
    """Results cannot be written."""


class RunError(UserError):
    """The pipeline refused its input, or a needed package is missing."""


class OptionError(UserError):
    """An option of the command line has an invalid value or contradicts another."""
