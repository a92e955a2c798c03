// Transfer function of cuboids: the record's box, its colour from its value. Goes behind gradient.glsl.

in vec2 center, extent, height;
in float value;
out Cuboid { vec3 lower, upper, colour; flat int drawn; } cuboid;

void main() {
    cuboid.lower = vec3(center - 0.5 * extent, min(height.x, height.y));
    cuboid.upper = vec3(center + 0.5 * extent, max(height.x, height.y));
    cuboid.colour = colour_of(value);
    cuboid.drawn = int(is_drawn(value));
}
