// Polygons as attributed vertices: what the geometry shader makes a wedge from. Goes behind polygon.glsl.

out Wedge { vec3 start, end, center, colour, normal; float upper; flat int has_side, has_ends; } wedge;

void main() {
    Polygon of = owner_of();
    bool drawn = is_drawn(of.value);
    float lower = min(of.lower, of.upper);
    wedge.start = vec3(position, lower);
    wedge.end = vec3(next_position, lower);
    wedge.center = vec3(apex, lower);
    wedge.upper = max(of.lower, of.upper);
    wedge.colour = colour_of(of.value);
    wedge.has_side = int(drawn && has_side());
    wedge.has_ends = int(drawn && has_ends());
    wedge.normal = wedge.has_side == 1 ? outward() : vec3(0.0);
}
