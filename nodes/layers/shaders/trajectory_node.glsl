// A record → a node. Goes behind trajectory.glsl.

layout(std430, binding = 1) restrict readonly buffer Selection { uint selection[]; };

uniform int colour_by;           // 0: speed, 1: acceleration, 2: time, 3: height
uniform float ground;            // height of the layer's origin
uniform vec2 acceleration_range; // the least and the largest radius belong to these
uniform vec2 radius_range;

// motion: time, speed, acceleration.  owner: 8 × number of the trajectory + HIDDEN, CAP, ALONE
Node node_of(vec3 position, vec3 motion, uint owner) {
    float span = acceleration_range.y - acceleration_range.x;
    float t = span != 0.0 ? clamp((abs(motion.z) - acceleration_range.x) / span, 0.0, 1.0) : 0.5;
    Node n;
    n.position = position;
    n.value = colour_by == 0 ? motion.y : colour_by == 1 ? motion.z : colour_by == 2 ? motion.x : position.z + ground;
    n.radius = mix(radius_range.x, radius_range.y, t);
    n.pixel = pixel_at(position);
    uint trajectory = owner >> 3;
    bool selected = (selection[trajectory >> 5] >> (trajectory & 31u) & 1u) == 1u;
    n.flags = (owner & 7u) | (selected ? SELECTED : 0u);
    return n;
}
