// Blocks by hardware instancing: a template of 14 vertices, the record once an instance. Behind gradient.glsl,
// block_output.glsl.

in vec3 corner, normal;  // the template
in ivec4 cell_and_type;
uniform float block_size;

void main() {
    int type = cell_and_type.w;
    put_block((vec3(cell_and_type.xyz) + 0.5 * corner) * block_size, normal, corner, type, is_drawn(float(type)));
}
