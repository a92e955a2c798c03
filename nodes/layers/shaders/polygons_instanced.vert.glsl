// Polygons by hardware instancing: a template of four triangles, the element once an instance. Behind output.glsl,
// polygon.glsl.

in ivec2 corner;  // which vertex of the wedge, in the order of its strip; 0: lower end, 1: side, 2: upper end

void main() {
    Polygon of = owner_of();
    bool is_side = corner.y == 1;
    vec2 at = corner.x == 0 || corner.x == 5 ? apex : (corner.x & 1) == 1 ? next_position : position;
    float z = corner.x < 3 ? min(of.lower, of.upper) : max(of.lower, of.upper);
    bool drawn = is_drawn(of.value) && (is_side ? has_side() : has_ends());
    put(vec3(at, z), is_side && drawn ? outward() : vec3(0.0, 0.0, float(corner.y - 1)), colour_of(of.value), drawn);
}
