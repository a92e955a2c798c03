// One instance a splat, four vertices: the rectangle that the splat may cover. No point sprites, for those end at the
// driver's point size (255 px on llvmpipe) and vanish with their centres.

uniform bool everything;  // or only what no quad stands for
layout(std430, binding = 8) restrict readonly buffer Splats { Splat splats[]; };
flat out vec4 place_w_radius;
flat out vec2 gradient;
#ifdef PASS_COLOUR
flat out vec3 rgb;
#endif

void main() {
    Splat s = splats[gl_InstanceID];
#ifdef PASS_COLOUR
    rgb = vec3(s.colour & 2047u, s.colour >> 11 & 2047u, s.colour >> 22) / vec3(8.0, 8.0, 4.0);
#endif
    bool drawn = s.reach != 0u && (everything || s.radius > 0.0);
    place_w_radius = vec4(s.place, s.w, abs(s.radius));
    gradient = s.gradient;
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec2 pixel = s.place + corner * unpackHalf2x16(s.reach);
    gl_Position = drawn ? vec4(2.0 * pixel / viewport - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}
