// What a frame draws, as runs of points. A unit of work (a piece of a run, or one point of it) finds its run here.

layout(local_size_x = 64) in;

struct Run {
    uint first;       // point in the chunk
    uint count;
    uint stride;
    uint block;       // place of its matrix
    uint first_unit;  // units of the runs before
};
layout(std430, binding = 7) restrict readonly buffer Runs { Run runs[]; };
uniform uint n_runs;
uniform uint first_unit;  // of this batch
uniform uint n_units;

// Number of this invocation. Dispatches are folded: above the limit of one dimension they do nothing.
uint invocation() {
    return gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x + gl_GlobalInvocationID.x;
}

uint run_of(uint unit) {
    uint low = 0u, high = n_runs;
    while (high - low > 1u) {
        uint middle = (low + high) / 2u;
        if (runs[middle].first_unit <= unit) low = middle;
        else high = middle;
    }
    return low;
}
