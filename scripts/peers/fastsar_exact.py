"""Exact images by FastSAR, for `scripts/bench peers`; runs in an environment that holds FastSAR.

Every line of the standard input is a request: interpolator, upsampling, and the file for the image.
The answer is the seconds that the image took, from samples over frequency to pixels in memory.
FastSAR's former is set up once for each setting; that time is not counted.
"""

import sys
import time

import fastsar
import numpy as np


def main() -> None:
    given = np.load(sys.argv[1])
    count = int(given["pixels"])
    (left, right), (near, far) = given["x_m"], given["y_m"]
    step_x, step_y = (right - left) / (count - 1), (far - near) / (count - 1)
    formers = {}
    for request in sys.stdin:
        interpolator, upsampling, image_file = request.split(maxsplit=2)
        if (interpolator, upsampling) not in formers:
            formers[interpolator, upsampling] = fastsar.ExactFormer(
                given["positions_m"],
                float(given["first_hz"]),
                float(given["step_hz"]),
                given["history"].shape[1],
                count,
                count,
                step_x,
                step_y,
                backend="cpu",
                window=False,
                interp=interpolator,
                upsample=int(upsampling),
                ref=given["ref_m"],
                center=(left + count / 2 * step_x, near + count / 2 * step_y, 0.0),
            )
        former, history = formers[interpolator, upsampling], given["history"]
        start = time.perf_counter()
        image = former(history)
        seconds = time.perf_counter() - start
        np.save(image_file.strip(), image)
        print(seconds, flush=True)


if __name__ == "__main__":
    main()
