// Geometry generation of cuboids; goes behind cube.glsl and emit.glsl.

layout(points) in;
layout(triangle_strip, max_vertices = 14) out;
in Cuboid { vec3 lower, upper, colour; flat int drawn; } cuboid[];

void main() {
    if (cuboid[0].drawn == 0) return;
    for (int i = 0; i < 14; ++i)
        emit(mix(cuboid[0].lower, cuboid[0].upper, 0.5 + 0.5 * CORNER[i]), NORMAL[i], cuboid[0].colour);
    EndPrimitive();
}
