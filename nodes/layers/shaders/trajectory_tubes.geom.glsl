// Segments as tubes. Goes behind trajectory_input.glsl, tube.glsl, emit.glsl.

layout(lines_adjacency) in;
layout(triangle_strip, max_vertices = 2 * SIDES + 2) out;

void main() {
    Node start = node(1), end = node(2);
    float value = 0.5 * (start.value + end.value);
    if (!is_drawn(value) || !is_tube(start, end, value)) return;
    Tube tube = tube_of(node(0), start, end, node(3));
    vec3 colour = colour_of(value);
    for (int side = 0; side <= SIDES; ++side) {
        for (int at = 1; at >= 0; --at) {
            vec3 normal = tube_normal(tube, at, side);
            emit(tube.center[at] + tube.radius[at] * normal, normal, colour);
        }
    }
    EndPrimitive();
}
