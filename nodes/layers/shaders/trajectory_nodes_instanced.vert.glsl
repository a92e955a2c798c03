// Balls by hardware instancing: a strip of all bands, and a node once an instance.
// Goes behind trajectory_node.glsl, ball.glsl, output.glsl.

in ivec3 corner;  // band; 0: lower, 1: upper; which vertex
in vec3 position, motion;
in uint owner;

void main() {
    Node here = node_of(position, motion, owner);
    vec3 normal = ball_normal(corner.x, corner.y, corner.z);
    float radius = ball_of(here);
    put(position + radius * normal, normal, colour_of(here.value), radius > 0.0);
}
