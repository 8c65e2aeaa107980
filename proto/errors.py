"""The exception for errors that the user can correct."""


class UserError(Exception):
    """Bad input. The message says what is wrong, which value, and what to do.

    The command line prints the message without a stack trace and exits with status 2.
    """
