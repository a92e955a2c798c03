// Geometry generation of a segment; goes behind arc.glsl, output.glsl, emit.glsl. An arc has four segments or more, so
// none is both its start and its end.

layout(lines) in;
layout(triangle_strip, max_vertices = 12) out;
in Vertex { vec2 center, radius, height; vec3 colour; float angle; int side; } vertex[];

void main() {
    vec2 ends = vec2(vertex[0].angle, vertex[1].angle);
    int first = vertex[1].side != 0 ? 0 : 2, last = vertex[0].side != 0 ? 14 : 12;
    for (int i = first; i < last; ++i)
        emit(arc_corner(CORNER[i], vertex[0].center, ends, vertex[0].radius, vertex[0].height),
             arc_normal(FACE[i], ends), vertex[0].colour);
    EndPrimitive();
}
