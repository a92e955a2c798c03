// Blocks as they stand in the buffer: triangles and strips. Behind gradient.glsl, block_output.glsl.

in vec3 position, normal, local;
in int type;

void main() {
    put_block(position, normal, local, type, is_drawn(float(type)));
}
