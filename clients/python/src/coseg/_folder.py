"""The folder in which daemon and clients meet when nobody names an endpoint."""

from __future__ import annotations

import os
import stat
from contextlib import suppress

from coseg.errors import CosegError


def default_folder() -> str:
    """``$RUNTIME_DIRECTORY``, else ``$XDG_RUNTIME_DIR/coseg``, else ``/tmp/coseg-UID``.

    Raises :class:`CosegError` if anybody but this user and root could listen there. The folder of a
    service may let a group in, that of a user nobody. One below ``/tmp`` that is missing is made, so
    that nobody else makes it while the client waits for a daemon.
    """
    if folder := os.environ.get("RUNTIME_DIRECTORY"):
        check_folder(folder, forbidden=0o022)
        return folder
    if parent := os.environ.get("XDG_RUNTIME_DIR"):
        folder = f"{parent}/coseg"
    else:
        folder = f"/tmp/coseg-{os.getuid()}"
    if os.path.dirname(folder) == "/tmp":
        with suppress(FileExistsError):
            os.mkdir(folder, 0o700)
    check_folder(folder, forbidden=0o077)
    return folder


def check_folder(folder: str, forbidden: int) -> None:
    """Raises :class:`CosegError` if the folder, or a link to it, belongs to another user, or others may
    do what the bits say."""
    # A link is judged as well as what it leads to: who can change it can lead elsewhere.
    for follow in (False, True):
        try:
            found = os.stat(folder, follow_symlinks=follow)
        except FileNotFoundError:
            return
        doubt = "so whoever listens there need not be your daemon"
        me = os.getuid()
        if found.st_uid not in (me, 0):
            raise CosegError(
                f"{folder} belongs to user {found.st_uid}, not to {me}, {doubt}; remove it, set "
                "XDG_RUNTIME_DIR to a folder of your own, or name the daemon's endpoint"
            )
        mode = stat.S_IMODE(found.st_mode)
        if not stat.S_ISLNK(found.st_mode) and mode & forbidden:
            may, cure = ("enter", "700") if forbidden & 0o055 else ("write", "go-w")
            raise CosegError(
                f"{folder} has mode {mode:04o}, which lets others {may}, {doubt}; "
                f"`chmod {cure} {folder}` mends that"
            )
