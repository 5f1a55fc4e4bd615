"""Protocol of the programs that `scripts/bench peers` runs: a line of JSON answers each request.

The programs run in other environments, so this module needs only Python.
"""

import json
import os
import sys
from collections.abc import Callable


def serve(answer: Callable[..., dict]) -> None:
    """Answer requests, which are objects of keyword arguments, until the standard input ends.

    If a request raises, the answer is `refused` with the message of the error.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries must not mix with the answers
    for line in sys.stdin:
        try:
            found = answer(**json.loads(line))
        except Exception as error:  # any code may refuse a scene in its own way
            found = {"refused": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), file=answers, flush=True)
