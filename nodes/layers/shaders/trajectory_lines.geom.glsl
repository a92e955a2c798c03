// Segments as lines. Goes behind trajectory_input.glsl, emit.glsl.

layout(lines_adjacency) in;
layout(line_strip, max_vertices = 2) out;

void main() {
    Node start = node(1), end = node(2);
    float value = 0.5 * (start.value + end.value);
    if (!is_drawn(value) || is_tube(start, end, value) || !(style == AUTO || style == LINES)) return;
    emit(start.position, vec3(0.0), colour_of(value));
    emit(end.position, vec3(0.0), colour_of(value));
    EndPrimitive();
}
