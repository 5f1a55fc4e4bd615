/* The parts of an image that have a centre of their own, which are tiles or groups of points, and the lines they need.
 *
 * Kernels never receive absolute ranges. For every (part, channel) pair the host computes, in float64, the range of the
 * part's centre; kernels add the difference between the ranges of a pixel and of that centre.
 *
 * Build options
 *   ALIGNED  1: earlier stages have aligned every line on the centre of its part, whose echo is at the same sample of all
 *            lines and has phase 0; 0: its sample and phase are given for each (part, channel).
 *
 * ranges: int [parts][3], the channels that a part receives from: the first one, the one after the last, and the line of
 * the first one; the lines of the others follow. Tables per (part, channel), [parts][channel_pitch], begin with the part's
 * first channel. The parts at work begin at number first_range of `ranges`.
 *
 * reference_sample: int, the sample nearest to the centre's echo, counted from the line's first sample.
 * reference_fraction: float, from there to the centre's echo, samples.
 * reference_phase: float, of the centre's echo, cycles in [-0.5, 0.5).
 * centre_sample: with ALIGNED, the sample of the centre in every line.
 */

#include "samples.h"

typedef struct {
    int begin, end;
    __global const sample_t *lines;
} Part;

INLINE Part part_at(__global const int *ranges, int number, __global const sample_t *lines, int line_pitch)
{
    __global const int *range = ranges + 3 * number;
    return (Part){range[0], range[1], LINE(lines, range[2], line_pitch)};
}

/* Where the centre's echo lies in one line, and its phase. */
typedef struct {
    int sample;
    float fraction, phase;
} Reference;
