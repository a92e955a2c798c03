// What the last stage before rasterization hands to blocks.frag: 11 components, as in table 1.2 of the paper.
// A triangle has the normal and the type of its last vertex.

flat out vec3 layer_normal;
flat out int block_type;
out vec3 local_place;     // −1 … 1 in the block
#ifdef CAPTURED
out vec3 layer_position;  // for tests alone: nothing reads it
#endif
uniform mat4 clip_from_layer;

void put_block(vec3 position, vec3 normal, vec3 local, int type, bool drawn) {
    gl_Position = drawn ? clip_from_layer * vec4(position, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);  // outside of the image
    layer_normal = normal;
    block_type = type;
    local_place = local;
#ifdef CAPTURED
    layer_position = position;
#endif
}
