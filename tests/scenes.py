"""Lines of simulated scenes, which are made once and kept on disk for other processes and runs."""

import functools
import hashlib
import inspect
import os
import pickle
import shutil
from pathlib import Path

import tiers

FOLDER = tiers.ROOT / ".cache" / "scenes"


def kept(make):
    """Keep what a function returns, by its file, its arguments and the package's digest.

    The function may take other functions, such as reliefs, which count by their sources. What
    belongs to another state of the package is removed.
    """

    @functools.cache
    def cached(*arguments, **options):
        parts = [Path(inspect.getfile(make)).read_text(), *map(_written, arguments)]
        parts += [f"{name}={_written(value)}" for name, value in sorted(options.items())]
        key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:24]
        state = FOLDER / tiers.package_digest().hex()[:24]
        file = state / f"{make.__module__}.{make.__name__}-{key}"
        if file.exists():
            return pickle.loads(file.read_bytes())
        made = make(*arguments, **options)
        state.mkdir(parents=True, exist_ok=True)
        for other in FOLDER.iterdir():
            if other != state:
                shutil.rmtree(other, ignore_errors=True)
        partial = file.with_name(f"{file.name}.{os.getpid()}")
        partial.write_bytes(pickle.dumps(made))
        partial.replace(file)  # so that no process reads half of it
        return made

    return functools.wraps(make)(cached)


def _written(value):
    return inspect.getsource(value) if callable(value) else repr(value)
