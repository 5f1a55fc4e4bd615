/* Vectors in space, one per lane, and changes of distance that are computed without cancellation. */

#include "vectors.h"

/* In loops with a constant number of passes, Mesa's rusticl (25.0, on llvmpipe) passes to inline functions the value that a
 * struct had in an earlier pass. So no loop changes a Vector from pass to pass. With one lane, where the compiler unrolls
 * more loops, a Vector is not a struct. */
#if WIDTH == 1
typedef float3 Vector;
#else
typedef struct {
    vfloat x, y, z;
} Vector;
#endif

INLINE vfloat scalar_product(Vector a, Vector b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

INLINE vfloat magnitude(Vector a)
{
    return sqrt(scalar_product(a, a));
}

/* a + factor b */
INLINE Vector sum_of(Vector a, vfloat factor, Vector b)
{
    return (Vector){a.x + factor * b.x, a.y + factor * b.y, a.z + factor * b.z};
}

INLINE Vector midpoint(Vector a, Vector b)
{
    return (Vector){0.5f * (a.x + b.x), 0.5f * (a.y + b.y), 0.5f * (a.z + b.z)};
}

INLINE Vector uniform_vector(float3 a)
{
    return (Vector){a.x, a.y, a.z};
}

/* |D + d| - |D| without cancellation; 0 where D and d are 0. */
INLINE vfloat distance_change(Vector D, Vector d)
{
    const vfloat square = scalar_product(D, D);
    const vfloat change = d.x * (2.0f * D.x + d.x) + d.y * (2.0f * D.y + d.y) + d.z * (2.0f * D.z + d.z);
    return change / (sqrt(max(square + change, 0.0f)) + sqrt(square) + FLT_MIN);
}

/* The same for a receiver that moves on while the echo comes back: the q that satisfies q = |D + d - q b| - |D|, from
 *
 *     (1 - b.b) q^2 + 2 (|D| + (D + d).b) q - (2 D + d).d = 0. */
INLINE vfloat moving_distance_change(Vector D, Vector d, Vector b)
{
    const vfloat square = scalar_product(D, D), length = sqrt(square);
    const vfloat change = d.x * (2.0f * D.x + d.x) + d.y * (2.0f * D.y + d.y) + d.z * (2.0f * D.z + d.z);
    const vfloat half_slope = length + scalar_product(D, b) + scalar_product(d, b);
    const vfloat root = half_slope * half_slope + (1.0f - scalar_product(b, b)) * change;
    return change / (half_slope + sqrt(max(root, 0.0f)) + FLT_MIN);
}
