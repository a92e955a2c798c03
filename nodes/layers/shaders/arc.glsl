// An arc's segment as one strip, and how its vertices lie. A triangle has the normal of its last vertex.
// Corner: bit 0: the segment's end, bit 1: outer radius, bit 2: upper height.

const int RIGHT = 0, BACK = 1, TOP = 2, FRONT = 3, BOTTOM = 4, LEFT = 5;
const int CORNER[14] = int[](1, 5, 3, 7, 6, 5, 4, 1, 0, 3, 2, 6, 0, 4);
const int FACE[14] = int[](RIGHT, RIGHT, RIGHT, RIGHT, BACK, TOP, TOP, FRONT, FRONT, BOTTOM, BOTTOM, BACK, LEFT, LEFT);
// the first two are there where the arc ends with this segment, the last two where it starts with it

uniform float segments;      // of each arc; 0: as its size on the screen asks for
uniform float tolerance_px;  // between an arc and its chords

vec2 on_circle(float angle) { return vec2(cos(angle), sin(angle)); }

vec3 arc_corner(int corner, vec2 center, vec2 ends, vec2 radius, vec2 height) {
    float angle = (corner & 1) != 0 ? ends.y : ends.x;
    float r = (corner & 2) != 0 ? radius.y : radius.x, z = (corner & 4) != 0 ? height.y : height.x;
    return vec3(center + r * on_circle(angle), z);
}

// From the angles alone, so that no radius, span or height of 0 takes it away.
vec3 arc_normal(int face, vec2 ends) {
    vec2 out_ = on_circle(0.5 * (ends.x + ends.y)), start = on_circle(ends.x), end = on_circle(ends.y);
    if (face == RIGHT) return vec3(-end.y, end.x, 0.0);
    if (face == LEFT) return vec3(start.y, -start.x, 0.0);
    if (face == TOP) return vec3(0.0, 0.0, 1.0);
    if (face == BOTTOM) return vec3(0.0, 0.0, -1.0);
    return vec3(face == BACK ? out_ : -out_, 0.0);
}
