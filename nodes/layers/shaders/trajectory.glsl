// Transfer function of trajectories: nodes, and which geometry is made of them. Goes behind gradient.glsl.
// Nothing of it is in the buffers: styles, mappings and selection are uniforms, and a bit a trajectory.

struct Node { vec3 position; float value, radius, pixel; uint flags; };  // pixel: its size at the node, world units

const uint HIDDEN = 1u, CAP = 2u, ALONE = 4u, SELECTED = 8u;
const int AUTO = 0, LINES = 1, SPLATS = 2, SPHERES = 3, TUBES = 4;
const float BALL = 2.0, STEEP = 0.9;

uniform int style;
uniform vec2 highlight;          // values that are drawn as if selected
uniform float tube_px;           // tubes narrower than this are lines, where the style is auto
uniform vec3 eye;
uniform float near, focal_px;

// Of length 1; 0 stays 0. No square overflows or vanishes.
vec3 direction(vec3 v) {
    float largest = max(abs(v.x), max(abs(v.y), abs(v.z)));
    precise vec3 scaled = largest > 0.0 ? v / largest : vec3(0.0);
    precise float inverse = largest > 0.0 ? inversesqrt(dot(scaled, scaled)) : 0.0;
    precise vec3 result = scaled * inverse;
    return result;
}

// Two axes across t: the first is level, but where t is steep.
void across(vec3 t, out vec3 u, out vec3 v) {
    u = direction(abs(t.z) < STEEP ? vec3(t.y, -t.x, 0.0) : vec3(0.0, t.z, -t.y));
    v = cross(t, u);
}

bool is_highlighted(float value, uint flags) {
    return (flags & SELECTED) != 0u || (value >= highlight.x && value <= highlight.y);
}

float pixel_at(vec3 position) { return max(distance(position, eye), near) / focal_px; }

bool is_near(Node n) { return 2.0 * n.radius >= tube_px * n.pixel; }

// Whether a segment is as wide as tubes are anywhere: it may pass the eye with both its ends far away.
bool is_near(Node start, Node end) {
    vec3 along = end.position - start.position;
    float t = clamp(dot(eye - start.position, along) / max(dot(along, along), 1e-30), 0.0, 1.0);
    return 2.0 * max(start.radius, end.radius) >= tube_px * pixel_at(start.position + t * along);
}

bool is_tube(Node start, Node end, float value) {
    return is_highlighted(value, start.flags) || style == TUBES || (style == AUTO && is_near(start, end));
}

// Radius of the ball at a node, 0 for none; negative: a disc.
float ball_of(Node n) {
    if ((n.flags & HIDDEN) != 0u || !is_drawn(n.value)) return 0.0;
    if (style == SPHERES || is_highlighted(n.value, n.flags)) return BALL * n.radius;
    if (style == SPLATS) return -max(BALL * n.radius, 0.75 * n.pixel);
    bool tubes = style == TUBES || (style == AUTO && is_near(n));
    if ((n.flags & ALONE) != 0u) return tubes ? max(n.radius, 0.75 * n.pixel) : 0.75 * n.pixel;
    return tubes && (n.flags & CAP) != 0u ? n.radius : 0.0;
}
