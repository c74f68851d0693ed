"""The one exception that is the user's to mend."""


class InputError(ValueError):
    """Something that the user gave cannot be used.

    The message is one line: what was wrong, what was found, what to do. The command line prints it
    without a traceback and exits with 2; any other exception is a defect of ours and keeps its traceback.
    """


def explain_os_error(error: OSError) -> str:
    """What the system refused, in one line: a read-only folder, a full disk, a path that is none."""
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"
