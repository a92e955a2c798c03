// Cuboids by hardware instancing: a template of 14 vertices, the record once an instance. Behind gradient.glsl, output.glsl.

in vec3 corner, normal;  // the template
in vec2 center, extent, height;
in float value;

void main() {
    vec3 lower = vec3(center - 0.5 * extent, min(height.x, height.y));
    vec3 upper = vec3(center + 0.5 * extent, max(height.x, height.y));
    put(mix(lower, upper, 0.5 + 0.5 * corner), normal, colour_of(value), is_drawn(value));
}
