// Reads a buffer once, neighbours side by side; the result depends on every bit.
layout(local_size_x = 256) in;
layout(std430, binding = 0) restrict readonly buffer In { uvec4 vectors[]; };
layout(std430, binding = 1) restrict writeonly buffer Out { uint result; };
uniform uint n_vectors;

void main() {
    uvec4 mixed = uvec4(0u);
    for (uint i = gl_GlobalInvocationID.x; i < n_vectors; i += gl_NumWorkGroups.x * gl_WorkGroupSize.x)
        mixed ^= vectors[i];
    if ((mixed.x ^ mixed.y ^ mixed.z ^ mixed.w) == 1u) result = 1u;  // never for zeros, and no compiler knows
}
