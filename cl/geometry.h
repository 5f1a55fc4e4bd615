/* Vectors in space, one per lane, and how distances change without cancellation. */

#include "vectors.h"

typedef struct {
    vfloat x, y, z;
} Vector;

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
