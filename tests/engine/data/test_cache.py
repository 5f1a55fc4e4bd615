"""The cache folder is used only where no other user can write."""

import os
import stat
from pathlib import Path

import pytest

from clsas.engine.data import cache

OTHER = 54321  # another user

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give folders to others")


@pytest.fixture(autouse=True)
def shared_group(monkeypatch):
    """The group of files has other members."""
    monkeypatch.setattr(cache, "_is_private", lambda group: False)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The cache folder, which does not exist yet."""
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / "a" / "cache"))
    return tmp_path / "a" / "cache"


@pytest.fixture
def shared(tmp_path):
    """A folder to which everybody may add files, as /tmp is."""
    path = tmp_path / "shared"
    path.mkdir()
    path.chmod(0o1777)
    # pytest's own folder is closed to others, so that nothing in it would be exposed.
    for each in path.parents:
        if not each.stat().st_mode & stat.S_IXOTH:
            each.chmod(0o711)
    return path


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_folders_are_made_for_their_user_alone(folder, umask):
    before = os.umask(umask)
    try:
        assert cache.private_folder("workers", "one") == folder / "workers" / "one"
    finally:
        os.umask(before)
    for each in ("..", ".", "workers", "workers/one"):
        assert stat.S_IMODE((folder / each).stat().st_mode) == 0o700


@pytest.mark.parametrize(
    ("platform", "given", "expected"),
    [
        ("linux", None, "home/.cache/clsas"),
        ("linux", "", "home/.cache/clsas"),
        ("linux", "relative", "home/.cache/clsas"),
        ("linux", "/caches", "/caches/clsas"),
        ("darwin", None, "home/Library/Caches/clsas"),
    ],
)
def test_without_a_variable_it_lies_where_the_system_keeps_caches(
    tmp_path, monkeypatch, platform, given, expected
):
    monkeypatch.delenv("CLSAS_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("sys.platform", platform)
    if given is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", given)
    assert cache.cache_folder() == tmp_path / expected


def test_a_folder_that_does_not_exist_is_trusted_and_not_made(folder):
    assert cache.trusted_cache() == folder
    assert not folder.parent.exists()


def refused(path, monkeypatch, reason):
    monkeypatch.setenv("CLSAS_CACHE", str(path))
    for work in (cache.trusted_cache, cache.private_folder, lambda: cache.private_folder("a")):
        with pytest.raises(PermissionError) as error:
            work()
        assert f"the cache folder {path}" in str(error.value)
        assert reason in str(error.value)
        assert "CLSAS_CACHE" in str(error.value)


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o733, 0o722])
def test_a_folder_that_others_can_write_to_is_refused(shared, monkeypatch, mode):
    (shared / "cache").mkdir()
    (shared / "cache").chmod(mode)
    if mode & 0o011:
        refused(shared / "cache", monkeypatch, f"other users can write to {shared / 'cache'}")
    else:
        monkeypatch.setenv("CLSAS_CACHE", str(shared / "cache"))
        assert cache.trusted_cache() == shared / "cache"  # nobody else can enter it


def test_a_folder_in_one_that_others_can_write_to_is_refused(shared, monkeypatch):
    """Others could replace the folder by their own, unless the outer folder is sticky."""
    shared.chmod(0o777)
    (shared / "cache").mkdir(0o700)
    refused(shared / "cache", monkeypatch, f"other users can write to {shared}")
    shared.chmod(0o1777)
    assert cache.private_folder() == shared / "cache"


def test_what_lies_in_a_closed_folder_may_have_any_mode(shared, monkeypatch):
    """An example is ~/.cache with mode 0775 in a home folder with mode 0700."""
    shared.chmod(0o700)
    (shared / "cache").mkdir()
    (shared / "cache").chmod(0o775)
    monkeypatch.setenv("CLSAS_CACHE", str(shared / "cache"))
    assert cache.private_folder("workers") == shared / "cache" / "workers"


@as_root
@pytest.mark.parametrize("mode", [0o700, 0o755, 0o777])
def test_a_folder_of_another_user_is_refused(shared, monkeypatch, mode):
    (shared / "cache").mkdir()
    (shared / "cache").chmod(mode)
    os.chown(shared / "cache", OTHER, OTHER)
    refused(shared / "cache", monkeypatch, f"{shared / 'cache'} belongs to user {OTHER}")


@as_root
def test_a_folder_in_one_of_another_user_is_refused(shared, monkeypatch):
    os.chown(shared, OTHER, OTHER)
    shared.chmod(0o755)
    (shared / "cache").mkdir(0o700)
    refused(shared / "cache", monkeypatch, f"{shared} belongs to user {OTHER}")


@as_root
def test_a_symbolic_link_of_another_user_is_refused(shared, tmp_path, monkeypatch):
    """The link could point to another folder by the time that the cache is used."""
    own = tmp_path / "own"
    own.mkdir(0o700)
    (shared / "link").symlink_to(own)
    monkeypatch.setenv("CLSAS_CACHE", str(shared / "link" / "cache"))
    assert cache.private_folder() == shared / "link" / "cache"
    assert (own / "cache").is_dir()
    os.chown(shared / "link", OTHER, OTHER, follow_symlinks=False)
    refused(shared / "link", monkeypatch, f"{shared / 'link'} belongs to user {OTHER}")
    (tmp_path / "outer").symlink_to(shared / "link")
    refused(tmp_path / "outer", monkeypatch, f"{shared / 'link'} belongs to user {OTHER}")


def test_a_symbolic_link_where_others_can_replace_it_is_refused(shared, tmp_path, monkeypatch):
    (tmp_path / "own").mkdir(0o700)
    (shared / "link").symlink_to(tmp_path / "own")
    shared.chmod(0o777)
    refused(shared / "link", monkeypatch, f"other users can write to {shared}")


def test_a_loop_of_symbolic_links_ends(shared, monkeypatch):
    (shared / "a").symlink_to(shared / "b")
    (shared / "b").symlink_to(shared / "a")
    monkeypatch.setenv("CLSAS_CACHE", str(shared / "a"))
    with pytest.raises(OSError, match="a"):
        cache.private_folder()


@as_root
def test_a_folder_made_by_another_user_meanwhile_is_refused(shared, monkeypatch):
    """The other user creates it between the check and the creation."""
    make = Path.mkdir

    def raced(path, *args, **options):
        make(path, 0o777)
        os.chown(path, OTHER, OTHER)
        make(path, *args, **options)

    monkeypatch.setenv("CLSAS_CACHE", str(shared / "cache"))
    monkeypatch.setattr(Path, "mkdir", raced)
    with pytest.raises(PermissionError, match=f"belongs to user {OTHER}"):
        cache.private_folder("workers")


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
def test_another_users_private_cache_is_named(shared, monkeypatch):
    """The message names the folder, where the system says only 'Permission denied'."""
    (shared / "cache").mkdir(0o700)
    os.setegid(OTHER)
    os.seteuid(OTHER)
    try:
        refused(shared / "cache", monkeypatch, "you cannot read it")
        refused(shared / "cache" / "deeper", monkeypatch, "cannot be searched")
    finally:
        os.seteuid(0)
        os.setegid(0)


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
def test_a_cache_of_the_administrator_can_be_read(shared, monkeypatch):
    (shared / "cache").mkdir(0o755)
    monkeypatch.setenv("CLSAS_CACHE", str(shared / "cache"))
    os.setegid(OTHER)
    os.seteuid(OTHER)
    try:
        assert cache.trusted_cache() == shared / "cache"
        with pytest.raises(PermissionError, match=r"you cannot write to it.*CLSAS_CACHE"):
            cache.private_folder()
    finally:
        os.seteuid(0)
        os.setegid(0)


def test_a_file_in_its_place_is_named(folder):
    folder.parent.mkdir()
    folder.write_text("")
    for names in ((), ("deeper",)):
        with pytest.raises(PermissionError, match=f"{folder}.* is not a folder|cannot be created"):
            cache.private_folder(*names)


def test_a_folder_of_another_program_is_checked_by_the_same_rule(shared):
    (shared / "open").mkdir()
    (shared / "open").chmod(0o777)
    with pytest.raises(PermissionError, match=r"other users can write.*variable OTHER to a folder"):
        cache.made_private(shared / "open", "OTHER")
    assert cache.made_private(shared / "own" / "deeper", "OTHER") == shared / "own" / "deeper"


def test_a_user_without_a_home_directory_is_told_to_name_a_folder(monkeypatch):
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as it does without a home
    for name in ("CLSAS_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for work in (cache.trusted_cache, cache.private_folder):
        with pytest.raises(PermissionError, match=r"home directory is not known: set.*CLSAS_CACHE"):
            work()


def test_a_group_of_this_user_alone_is_nobody_else(shared, monkeypatch):
    """Many systems give each user such a group, and make folders with mode 0775."""
    (shared / "cache").mkdir()
    (shared / "cache").chmod(0o775)
    monkeypatch.setenv("CLSAS_CACHE", str(shared / "cache"))
    with pytest.raises(PermissionError):
        cache.trusted_cache()
    monkeypatch.setattr(cache, "_is_private", lambda group: True)
    assert cache.trusted_cache() == shared / "cache"
