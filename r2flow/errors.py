"""The exception for mistakes of the user."""

import errno


class InputError(ValueError):
    """Something that the user gave cannot be used.

    The message is one line: what was wrong, what was found, what to do. The command line prints it
    without a traceback and exits with 2; any other exception is a defect of ours and keeps its traceback.
    """


# System errors that a user can mend; others (a lost connection, a broken pipe) keep their traceback.
MENDABLE = {
    errno.EACCES, errno.EPERM, errno.ENOENT, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENOTEMPTY,
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


def explain_mistake(error: InputError | OSError) -> str:
    """A mistake in one line: an InputError's own, or what the system refused (a read-only folder, a full disk).

    Raises:
        OSError: the error itself, where a user cannot mend it.
    """
    if isinstance(error, OSError):
        if error.errno not in MENDABLE:
            raise error
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    # A loader's worker process wraps the line into its traceback; the line is the last of it.
    return str(error).strip().splitlines()[-1].split("InputError: ")[-1] if str(error).strip() else "unknown"
