"""Folder of a processing: its choice, its lock, and the files that may be replaced in it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from clsas.engine.data import validate
from clsas.engine.data.atomic import locked
from clsas.engine.data.validate import ArgumentError
from clsas.files.scene_files import SceneFile
from clsas.processing.record import NAME, StepRecord, read_records
from clsas.processing.recording import Recording
from clsas.processing.steps import FILES


def folder_of(scene: SceneFile, output: str | os.PathLike | None) -> Path:
    """Return the given folder, or that of the scene; raise ValueError if there is neither."""
    if output is not None:
        return validate.path("output", output)
    if "output" in scene.process:
        return scene.process["output"]
    if not Path(scene.name).suffix:
        allowed = "be given, since the scene has no file to name the folder after"
        raise ArgumentError("output", allowed)
    return Path(scene.name).with_suffix("")


def check_folder(folder: Path, recording: Recording) -> None:
    """Raise ValueError if the folder cannot be created, or contains the recording."""
    source = recording.described["file"]
    if source is not None and Path(source).parent.resolve() == folder.resolve():
        raise ArgumentError("output", "not be the folder of the recording", repr(str(folder)))
    if folder.exists() and not folder.is_dir():
        raise ArgumentError("output", "be a folder", f"the file {str(folder)!r}")
    if not folder.parent.is_dir():
        hint = f"there is no folder {str(folder.parent)!r}"
        raise ArgumentError("output", "lie in an existing folder", repr(str(folder)), hint)


def checked_records(
    scene: SceneFile, folder: Path, names: tuple[str, ...]
) -> dict[str, StepRecord]:
    """Return the records of the folder after checking that steps replace only their own files.

    A damaged record is replaced by one without inputs, so that its step runs again and may replace
    the files that it may have written.

    Raises
    ------
    ValueError
        If the folder contains the record of another scene, or a file that a step would replace and
        that no record names.
    OSError
        If the record cannot be read.

    Warns
    -----
    ClsasWarning
        If records are damaged.
    """
    records, is_damaged = read_records(folder, scene)
    if is_damaged:
        lost = {name: FILES[name] for name in FILES if name not in records}
        for name, files in lost.items():
            if found := [file for file in files if os.path.lexists(folder / file)]:
                records[name] = StepRecord(name, "", files=dict.fromkeys(found, ""))
        again = [name for name in lost if name in records or name in names]
        validate.warn(f"{folder / NAME} is damaged; these steps are run again: {', '.join(again)}")
    own = {file for record in records.values() for file in record.files}
    for name in names:
        for file in FILES[name]:
            if file not in own and os.path.lexists(folder / file):
                raise ArgumentError(
                    "output",
                    f"not contain {file}, which {name} would replace and clsas did not write",
                    repr(str(folder)),
                    "choose another folder, or remove the file",
                )
    return records


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Lock a folder, and create it if it does not exist; then it is removed again if still empty.

    Raises
    ------
    BlockingIOError
        If another process has locked the folder.
    OSError
        If the folder cannot be created.
    """
    is_new = False
    try:
        with ExitStack() as held:
            while True:
                is_new = is_new or not folder.is_dir()
                folder.mkdir(exist_ok=True)
                # Another process may remove the folder, which it created, before this one locks it.
                with suppress(FileNotFoundError):
                    held.enter_context(locked(folder))
                    break
            yield
    finally:
        if is_new:
            with suppress(OSError):  # the folder is not empty
                folder.rmdir()
