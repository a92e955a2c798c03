// The quad of a flat cell in the visibility pass, clipped in front of the near plane.

struct Quad { vec4 middle, a, b; };  // eye space; half axes
layout(std430, binding = 8) restrict readonly buffer Quads { Quad quads[]; };
flat out vec3 middle, a, b;

void main() {
    Quad quad = quads[gl_InstanceID];
    middle = quad.middle.xyz;
    a = quad.a.xyz;
    b = quad.b.xyz;
    vec2 corner = 1.01 * (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0);  // its border is found by the fragment
    vec3 p = middle + corner.x * a + corner.y * b;
    gl_Position = vec4(2.0 * (focal * p.xy + center * p.z) / viewport - p.z, p.z - near, p.z);  // clips w < near / 2
}
