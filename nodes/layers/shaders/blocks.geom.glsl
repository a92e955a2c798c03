// Geometry generation of blocks; goes behind gradient.glsl, cube.glsl, block_output.glsl.

layout(points) in;
layout(triangle_strip, max_vertices = 14) out;
in int type_of_block[];
uniform float block_size;

void main() {
    int type = type_of_block[0];
    if (!is_drawn(float(type))) return;
    for (int i = 0; i < 14; ++i) {
        put_block((gl_in[0].gl_Position.xyz + 0.5 * CORNER[i]) * block_size, NORMAL[i], CORNER[i], type, true);
        EmitVertex();
    }
    EndPrimitive();
}
