"""A client does not talk to whoever made the default folder first."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import coseg
from coseg._folder import check_folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("COSEG_ENDPOINT", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made = tmp_path / "coseg"
    made.mkdir(mode=0o700)
    return made


def test_a_folder_that_others_may_enter_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert coseg.default_endpoint() == f"ipc://{folder}/coseg.sock"
    for mode in (0o755, 0o750, 0o777):
        folder.chmod(mode)
        with pytest.raises(coseg.CosegError, match=f"{folder} has mode {mode:04o}.*`chmod 700 {folder}`"):
            coseg.Library()
    # An endpoint that is named is not judged.
    monkeypatch.setenv("COSEG_ENDPOINT", f"ipc://{folder}/coseg.sock")
    coseg.Library().close()


def test_a_service_may_let_a_group_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(folder))
    folder.chmod(0o750)
    assert coseg.default_endpoint() == f"ipc://{folder}/coseg.sock"
    folder.chmod(0o770)
    with pytest.raises(coseg.CosegError, match=f"lets others write.*`chmod go-w {folder}`"):
        coseg.default_endpoint()


def test_links_are_followed_and_what_is_missing_is_nobody_s(folder: Path) -> None:
    link = folder.parent / "link"
    link.symlink_to(folder)
    check_folder(str(link), 0o077)
    folder.chmod(0o755)
    with pytest.raises(coseg.CosegError):
        check_folder(str(link), 0o077)
    check_folder(str(folder / "missing"), 0o077)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_refused(folder: Path) -> None:
    os.chown(folder, 12345, -1)
    with pytest.raises(coseg.CosegError, match=f"{folder} belongs to user 12345, not to 0"):
        coseg.Library()
