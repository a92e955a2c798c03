// Blocks: the texture of the type, lit; goes behind word.glsl.

flat in vec3 layer_normal;
flat in int block_type;
in vec3 local_place;
uniform sampler2DArray textures;

void main() {
    // the axes of the face: its normal is along the third
    vec3 along = abs(layer_normal);
    vec2 place = along.x > 0.5 ? local_place.yz : along.y > 0.5 ? local_place.xz : local_place.xy;
    vec3 colour = texture(textures, vec3(0.5 + 0.5 * place, float(block_type))).rgb;
    write_word(colour * (AMBIENT + DIFFUSE * max(dot(layer_normal, KEY), 0.0) + 0.5 * HEAD));
}
