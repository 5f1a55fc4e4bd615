"""Files appear complete or not at all, and leftovers of killed writers are removed."""

import errno
import fcntl
import os
import signal
import stat
import subprocess
import sys

import pytest

from clsas.engine.data import atomic
from clsas.engine.data.atomic import (
    assembling,
    creating,
    locked,
    replacing,
    replacing_folder,
    staging,
)


@pytest.mark.parametrize("names", [None, "the temporary one"])
def test_a_full_disk_names_the_file_that_was_to_be_written(tmp_path, names):
    """The error names the user's file, not the temporary one, and the old file stays."""
    path = tmp_path / "image.h5"
    path.write_text("before")

    def write():
        with replacing(path) as part:
            part.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device", names and str(part))

    with pytest.raises(OSError, match="No space left") as caught:
        write()
    assert caught.value.filename == str(path)
    assert [each.name for each in tmp_path.iterdir()] == ["image.h5"]
    assert path.read_text() == "before"


@pytest.mark.parametrize(
    ("write", "within", "named"),
    [
        (creating, "x/zarr.json", "made/x/zarr.json"),
        (replacing_folder, "tiles/0/1.png", "made/tiles/0/1.png"),
        (staging, "focus.h5", "made/focus.h5"),
        (staging, None, "made"),
        (assembling, "", "made"),
        (assembling, ".aux.xml", "made.aux.xml"),
    ],
)
def test_an_error_in_a_temporary_folder_names_the_later_file(tmp_path, write, within, named):
    made = tmp_path / "made"
    if write is staging:
        made.mkdir()

    def fill():
        with write(made) as part:
            name = f"{part}{within}" if write is assembling else within and str(part / within)
            raise OSError(errno.EDQUOT, "Disk quota exceeded", name)

    with pytest.raises(OSError, match="quota") as caught:
        fill()
    assert (caught.value.errno, caught.value.filename) == (errno.EDQUOT, str(tmp_path / named))
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("name", ["focus.h5", "image.png"])
def test_a_full_disk_names_a_file_in_a_folder_whose_files_are_to_move(tmp_path, name):
    def write():
        with staging(tmp_path) as folder, replacing(folder / name) as part:
            part.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space") as caught:
        write()
    assert caught.value.filename == str(tmp_path / name)


def killed_in(statement, folder):
    """Kill a process while it writes, and return the files that it leaves behind."""
    program = f"""
import os, signal
from pathlib import Path
from clsas.engine.data.atomic import creating, locked, replacing, staging
path = Path({str(folder / "a.h5")!r})
with {statement} as part:
    (part / "x" if part.is_dir() else part).write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == -signal.SIGKILL
    return list(folder.glob(".clsas-*.part"))


@pytest.mark.parametrize("statement", ["replacing(path)", "creating(path)", "staging(path.parent)"])
def test_the_next_writer_removes_what_a_killed_one_left(tmp_path, statement):
    assert len(killed_in(statement, tmp_path)) == 1
    with replacing(tmp_path / "b.h5") as part:
        part.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["b.h5"]


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


BEFORE, AFTER = {"a": "before", "b": "before"}, {"b": "after", "c": "after"}
ENDED = 7


def exit_after(name, folder):
    """Replace a folder in a process that ends after the first or a later call of a function."""
    program = f"""
import os
from pathlib import Path
from clsas.engine.data import atomic

def ending(work, calls):
    def wrapped(*given):
        found = work(*given)
        calls.append(found)
        if len(calls) == {name[-1]}:
            os._exit({ENDED})
        return found
    return wrapped

if {name!r}.startswith("exchange"):
    atomic._exchanged = ending(atomic._exchanged, [])
else:
    atomic._exchanged = lambda *_: False
    os.rename = ending(os.rename, [])
with atomic.replacing_folder(Path({str(folder)!r})) as new:
    for name in "bc":
        (new / name).write_text("after")
"""
    return subprocess.run([sys.executable, "-c", program], check=False).returncode


@pytest.mark.parametrize(
    ("killed", "left"), [("exchange 1", AFTER), ("rename 1", BEFORE), ("rename 2", AFTER)]
)
def test_a_kill_leaves_a_whole_folder_that_the_next_command_keeps(tmp_path, killed, left):
    path = tmp_path / "web"
    path.mkdir()
    for name, text in BEFORE.items():
        (path / name).write_text(text)
    assert exit_after(killed, path) == ENDED
    with replacing(tmp_path / "other") as part:
        part.write_text("whole")
    try:
        with replacing_folder(path):
            assert contents(path) == left
            raise InterruptedError
    except InterruptedError:
        assert contents(path) == left
    with replacing_folder(path) as new:
        (new / "d").write_text("last")
    assert contents(path) == {"d": "last"}
    assert sorted(each.name for each in tmp_path.iterdir()) == ["other", "web"]


def test_folders_are_exchanged_in_one_step_where_the_system_can(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "name").write_text(name)
    if not atomic._exchanged(tmp_path / "first", tmp_path / "second"):
        pytest.skip("this system or file system exchanges no folders")
    assert contents(tmp_path / "first") == {"name": "second"}
    assert contents(tmp_path / "second") == {"name": "first"}
    with pytest.raises(FileNotFoundError, match="gone"):
        atomic._exchanged(tmp_path / "first", tmp_path / "gone")


def test_what_another_writer_is_at_stays(tmp_path):
    with creating(tmp_path / "folder") as folder, replacing(tmp_path / "a") as first:
        (folder / "x").write_text("x")
        with replacing(tmp_path / "b") as second:
            second.write_text("b")
        first.write_text("a")
    assert (tmp_path / "folder" / "x").read_text() == "x"
    assert [(tmp_path / name).read_text() for name in "ab"] == ["a", "b"]
    assert len(list(tmp_path.iterdir())) == 3


def test_another_writer_never_finds_a_file_unlocked(tmp_path, monkeypatch):
    """Linux frees a lock for a moment when its kind is changed."""
    flock, locked = fcntl.flock, set()

    def changed(descriptor, operation):
        if descriptor in locked:
            flock(descriptor, fcntl.LOCK_UN)
            with replacing(tmp_path / "b") as other:
                other.write_text("b")
        flock(descriptor, operation)
        locked.add(descriptor)

    monkeypatch.setattr(fcntl, "flock", changed)
    with replacing(tmp_path / "a") as part:
        part.write_text("a")
    assert (tmp_path / "a").read_text() == "a"


def test_names_alike_stay(tmp_path):
    """Files of other programs stay, and so do links and pipes with such a name."""
    (tmp_path / ".other-0.part").touch()
    (tmp_path / "precious").write_text("precious")
    (tmp_path / ".clsas-0.part").symlink_to(tmp_path / "precious")
    os.mkfifo(tmp_path / ".clsas-1.part")
    with replacing(tmp_path / "a") as part:
        part.write_text("a")
    assert (tmp_path / "precious").read_text() == "precious"
    assert (tmp_path / ".other-0.part").exists()


def test_a_temporary_with_the_name_of_a_leftover_is_not_removed(tmp_path, monkeypatch):
    """The leftover is removed and its name taken again before its lock is granted."""
    path = tmp_path / ".clsas-leftover.part"
    path.write_text("old")
    lock = fcntl.flock

    def slow(descriptor, how):
        path.unlink()
        path.write_text("new")
        lock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", slow)
    atomic._remove_leftovers(tmp_path)
    assert path.read_text() == "new"


def test_a_temporary_taken_for_a_leftover_is_made_anew(tmp_path, monkeypatch):
    """Another writer may remove a file after it was created and before it is locked."""
    flock, calls = fcntl.flock, []

    def raced(descriptor, operation):
        if not calls:
            for path in tmp_path.glob(".clsas-*.part"):
                path.unlink()
        calls.append(operation)
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", raced)
    with replacing(tmp_path / "a") as part:
        part.write_text("a")
    assert calls.count(fcntl.LOCK_SH) == 2
    assert (tmp_path / "a").read_text() == "a"


def test_contents_reach_the_disk_before_the_name(tmp_path, monkeypatch):
    done = []
    sync, rename = os.fsync, os.replace

    def synced(descriptor):
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", lambda *paths: done.append("name") or rename(*paths))
    with replacing(tmp_path / "a") as part:
        part.write_text("a")
    assert done == ["file", "name", "folder"]


def test_a_file_may_be_read_under_a_lock_once_it_has_its_name(tmp_path, monkeypatch):
    """HDF5 takes a shared lock for reading. The folder has not reached the disk by then."""
    path, seen = tmp_path / "a", []

    def read(_folder):
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            seen.append(file.read())

    monkeypatch.setattr(atomic, "sync_folder", read)
    with atomic.replacing(path) as temporary:
        temporary.write_bytes(b"contents")
    assert seen == [b"contents"]


def test_a_folder_that_another_made_meanwhile_stays(tmp_path):
    with creating(tmp_path / "a") as part:
        (part / "ours").touch()
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "theirs").touch()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["theirs"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_symbolic_link_stays_and_its_target_is_replaced(tmp_path):
    (tmp_path / "disk").mkdir()
    target = tmp_path / "disk" / "image.h5"
    for before in (None, "before"):  # a link may point to a file that does not exist yet
        if before is not None:
            target.write_text(before)
        link = tmp_path / f"link-{before}"
        link.symlink_to("disk/image.h5")
        with replacing(link) as part:
            assert part.parent == target.parent
            part.write_text("after")
        assert link.is_symlink()
        assert target.read_text() == "after"
        target.unlink()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_the_mode_of_a_file_stays(tmp_path, mode):
    path = tmp_path / "image.h5"
    path.write_text("before")
    path.chmod(mode)
    with replacing(path) as part:
        assert stat.S_IMODE(part.stat().st_mode) == mode  # while it is written, too
        part.write_text("after")
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_text() == "after"


def test_a_new_file_has_the_usual_mode(tmp_path):
    (tmp_path / "usual").touch()
    with replacing(tmp_path / "image.h5") as part:
        part.write_text("new")
    modes = {path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(modes) == 1


@pytest.mark.parametrize("linked", [False, True])
def test_pipes_and_devices_are_refused(tmp_path, linked):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, kind in ((pipe, "a pipe"), ("/dev/null", "a device")):
        given = path
        if linked:
            given = tmp_path / f"link to {kind}"
            given.symlink_to(path)
        with (
            pytest.raises(ValueError, match=f"must be an ordinary file, got {kind}"),
            replacing(given),
        ):
            pytest.fail("there is nothing to write")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert not list(tmp_path.glob(".clsas-*"))


def test_a_loop_of_links_is_refused(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to("loop")
    with pytest.raises(OSError, match="levels of symbolic links"), replacing(loop):
        pytest.fail("there is nothing to write")
    assert loop.is_symlink()


def test_a_folder_is_locked_once_at_a_time(tmp_path):
    with locked(tmp_path):
        for _ in range(2):
            with (
                pytest.raises(BlockingIOError, match="at work in this folder") as caught,
                locked(tmp_path),
            ):
                pytest.fail("two have the lock")
            assert caught.value.filename == str(tmp_path)
    assert not list(tmp_path.iterdir())
    with locked(tmp_path):
        pass


def test_a_killed_process_leaves_no_lock(tmp_path):
    program = f"""
import os, signal
from pathlib import Path
from clsas.engine.data.atomic import locked
with locked(Path({str(tmp_path)!r})):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    with locked(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_lock_whose_file_was_removed_meanwhile_is_taken_anew(tmp_path, monkeypatch):
    import fcntl

    flock, calls = fcntl.flock, []

    def raced(descriptor, operation):
        if not calls:
            (tmp_path / ".clsas.lock").unlink()
        calls.append(operation)
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", raced)
    with locked(tmp_path), pytest.raises(BlockingIOError), locked(tmp_path):
        pytest.fail("two have the lock")
    assert len(calls) == 3


def test_a_folder_that_cannot_be_written_needs_no_lock(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refused)
    with locked(tmp_path):
        assert not list(tmp_path.iterdir())
