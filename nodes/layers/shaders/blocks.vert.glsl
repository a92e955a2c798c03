// Transfer function of blocks: the record passes as it is.

in ivec4 cell_and_type;
out int type_of_block;

void main() {
    gl_Position = vec4(cell_and_type.xyz, 1.0);
    type_of_block = cell_and_type.w;
}
