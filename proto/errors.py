"""The one exception that means "the user can mend this"."""


class UserError(Exception):
    """Bad input. The message says what was wrong, which value, and what to do.

    The command line prints the message without a stack trace and exits with status 2.
    """
