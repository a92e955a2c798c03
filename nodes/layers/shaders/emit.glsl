// Emission of a vertex by a geometry shader; goes behind output.glsl.

void emit(vec3 position, vec3 normal, vec3 colour) {
    put(position, normal, colour, true);
    EmitVertex();
}
