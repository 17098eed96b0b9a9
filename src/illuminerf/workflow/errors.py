"""The one error a person is meant to read."""


class UserError(Exception):
    """Something outside the program is wrong, and the person at the keyboard can put it right.

    The message is one line: what is wrong, what was found, what was expected, and what to do about it. The
    command line prints it without a traceback and exits with status 2.
    """

    def __init__(self, what: str, *, got: str = "", wanted: str = "", fix: str = "") -> None:
        self.what, self.got, self.wanted, self.fix = what, got, wanted, fix
        parts = [what.rstrip(".")]
        parts += [f"got {got}"] if got else []
        parts += [f"wanted {wanted}"] if wanted else []
        message = "; ".join(parts) + "."
        super().__init__(f"{message} Fix: {fix.rstrip('.')}." if fix else message)
