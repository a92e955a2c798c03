// Transfer function of polygons: an element, the next one's position, and the object they belong to.
// Goes behind gradient.glsl.

in vec2 position, apex, next_position;
in uint owner;  // twice the number of the object, and 1 where a side face stands on the edge

struct Polygon { float lower, upper, value; };
layout(std430, binding = 0) restrict readonly buffer Objects { Polygon objects[]; };

Polygon owner_of() {
    return objects[owner >> 1];
}

bool has_side() {
    return (owner & 1u) == 1u;
}

bool has_ends() {
    return position != apex && next_position != apex;
}

vec3 outward() {
    vec2 along = normalize(next_position - position);
    return vec3(along.y, -along.x, 0.0);
}
