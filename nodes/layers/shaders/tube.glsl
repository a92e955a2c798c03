// Tubes: a ring at each end of a segment. Two segments share the ring between them, which lies between their
// directions and is made from the same numbers in the same way; where they turn too sharply for that, and at ends, the
// ring is across the segment, and there is a ball. Goes behind trajectory.glsl. SIDES: of a ring.

vec3 joint(vec3 before, vec3 at, vec3 after) {
    precise vec3 t = direction(direction(at - before) + direction(after - at));
    return t;
}

struct Tube { vec3 center[2], u[2], v[2]; float radius[2]; int shift; };

Tube tube_of(Node before, Node start, Node end, Node after) {
    vec3 a = start.position, b = end.position, along = direction(b - a);
    vec3 from = (start.flags & CAP) != 0u ? along : joint(before.position, a, b);
    vec3 to = (end.flags & CAP) != 0u ? along : joint(a, b, after.position);
    Tube tube;
    tube.center[0] = a;
    tube.center[1] = b;
    tube.radius[0] = start.radius;
    tube.radius[1] = end.radius;
    across(from, tube.u[0], tube.v[0]);
    across(to, tube.u[1], tube.v[1]);
    // vertices of the rings that face each other are joined, so that a tube is not twisted by more than half a side
    float angle = atan(dot(tube.u[0], tube.v[1]), dot(tube.u[0], tube.u[1]));
    tube.shift = int(round(angle / (6.28318531 / SIDES)));
    return tube;
}

vec3 tube_normal(Tube tube, int end, int side) {
    int turned = (side + end * tube.shift + SIDES) % SIDES;
    float angle = 6.28318531 / SIDES * turned;
    return cos(angle) * tube.u[end] + sin(angle) * tube.v[end];
}
