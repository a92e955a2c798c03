// Tubes by hardware instancing: a strip, and the places of a segment's four nodes once an instance.
// Goes behind trajectory_node.glsl, tube.glsl, output.glsl.

struct Record { float x, y, z, time, speed, acceleration; uint owner; };
layout(std430, binding = 0) restrict readonly buffer Records { Record records[]; };
in ivec2 corner;  // 0: start, 1: end; which vertex of the ring
in ivec4 segment;

Node node(int i) {
    Record r = records[i];
    return node_of(vec3(r.x, r.y, r.z), vec3(r.time, r.speed, r.acceleration), r.owner);
}

void main() {
    Node start = node(segment.y), end = node(segment.z);
    float value = 0.5 * (start.value + end.value);
    Tube tube = tube_of(node(segment.x), start, end, node(segment.w));
    vec3 normal = tube_normal(tube, corner.x, corner.y);
    put(tube.center[corner.x] + tube.radius[corner.x] * normal, normal, colour_of(value),
        is_drawn(value) && is_tube(start, end, value));
}
