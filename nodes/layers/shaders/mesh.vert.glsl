// Triangles and strips as they stand in the buffer: the baselines. Behind gradient.glsl, output.glsl.

in vec3 position, normal;
in float value;

void main() {
    put(position, normal, colour_of(value), is_drawn(value));
}
