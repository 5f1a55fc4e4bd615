"""How a program beside `scripts/bench peers` answers: one line of JSON for every line of requests.

The programs run in environments of their own, so this file needs Python only.
"""

import json
import os
import sys
from collections.abc import Callable


def serve(answer: Callable[..., dict]) -> None:
    """Answer requests, objects of keyword arguments, until the standard input ends.

    What raises is answered by `refused`, with the error's message.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print must not get between the answers
    for line in sys.stdin:
        try:
            found = answer(**json.loads(line))
        except Exception as error:  # any code may refuse a scene in its own way
            found = {"refused": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), file=answers, flush=True)
