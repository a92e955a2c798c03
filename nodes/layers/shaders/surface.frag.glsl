// Lit surfaces of one colour a triangle; goes behind word.glsl.

in vec3 layer_position;
#ifdef FLAT
flat in vec3 layer_normal;
#else
in vec3 layer_normal;
#endif
flat in vec3 base_colour;
uniform vec3 eye;

void main() {
    vec3 n = normalize(layer_normal), view = normalize(eye - layer_position);
    if (dot(n, view) < 0.0) n = -n;
    write_word(base_colour * (AMBIENT + DIFFUSE * max(dot(n, KEY), 0.0) + HEAD * dot(n, view)));
}
