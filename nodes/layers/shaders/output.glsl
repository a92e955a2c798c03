// What the last stage before rasterization hands to surface.frag, and how a vertex is put there.
// FLAT: a triangle has the normal of its last vertex.

out vec3 layer_position;
#ifdef FLAT
flat out vec3 layer_normal;
#else
out vec3 layer_normal;
#endif
flat out vec3 base_colour;
uniform mat4 clip_from_layer;

void put(vec3 position, vec3 normal, vec3 colour, bool drawn) {
    gl_Position = drawn ? clip_from_layer * vec4(position, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);  // outside of the image
    layer_position = position;
    layer_normal = normal;
    base_colour = colour;
}
