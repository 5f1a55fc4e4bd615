/* A short filter over consecutive samples, which slides along a line one vector at a time.
 *
 * Each vector of the line is loaded once. The samples under the later taps are shuffled, by constants, from two vectors
 * that follow each other: loads that cross cache lines are slower. SLIDING is defined where compilers can do this.
 * Elsewhere align_line() loads a vector for each tap.
 *
 * Build options
 *   TAPS  of the filter: 2, 4, 6 or 8.
 */

#include "x86.h"

#if defined(__clang__) && WIDTH >= 8
#define SLIDING
#if TAPS > 8
#error "TAPS must be at most 8"
#endif

/* The WIDTH samples from number t on of the 2 WIDTH in two vectors. */
#if AVX == 256
/* One instruction shifts both halves of a vector, where compilers take two. It works on samples `low` and those half a
 * vector later, or on the latter and `high`. */
INLINE vfloat shifted_halves(vfloat low, vfloat high, const int t)
{
    vfloat shifted;
    __asm__("vpalignr %3, %1, %2, %0" : "=x"(shifted) : "x"(low), "x"(high), "i"(4 * t));
    return shifted;
}
#define BETWEEN(low, high) __builtin_shufflevector(low, high, 4, 5, 6, 7, 8, 9, 10, 11)
#define SHIFTED(low, high, t)                                       \
    ((t) < 4 ? shifted_halves(low, BETWEEN(low, high), (t) & 3)     \
             : shifted_halves(BETWEEN(low, high), high, (t) & 3))
#else
#define SHIFTED(low, high, t) __builtin_shufflevector(low, high, JOIN(FROM_, WIDTH)(t))
#define FROM_8(t) t, t + 1, t + 2, t + 3, t + 4, t + 5, t + 6, t + 7
#define FROM_16(t) FROM_8(t), t + 8, t + 9, t + 10, t + 11, t + 12, t + 13, t + 14, t + 15
#endif

/* sum_t weight[t] s[t], for the samples s that begin in `low` and go on in `high`. */
INLINE vfloat filtered(const float *weight, vfloat low, vfloat high)
{
    /* One product at a time: a compiler does not fuse a sum of two products with what it is added to. */
    vfloat sum = weight[0] * low;
    sum += weight[1] * SHIFTED(low, high, 1);
    if (TAPS > 2) {
        sum += weight[2] * SHIFTED(low, high, 2);
        sum += weight[3] * SHIFTED(low, high, 3);
    }
    if (TAPS > 4) {
        sum += weight[4] * SHIFTED(low, high, 4);
        sum += weight[5] * SHIFTED(low, high, 5);
    }
    if (TAPS > 6) {
        sum += weight[6] * SHIFTED(low, high, 6);
        sum += weight[7] * SHIFTED(low, high, 7);
    }
    return sum;
}
#endif
