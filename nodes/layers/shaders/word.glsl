// A framebuffer word: colour and the depth's bits. The binding offers 24-bit depth buffers only, so they get the depth
// as a logarithm: the float's bits counted from ``near``, 16 steps to one.

layout(location = 0) out uvec2 word;
uniform float near;

const vec3 KEY = vec3(0.387298, 0.258199, 0.885061);  // light from above, beside
const float AMBIENT = 0.42, DIFFUSE = 0.5, HEAD = 0.12;

void write_word(vec3 colour) {
    word = uvec2(packUnorm4x8(vec4(min(colour, 1.0), 1.0)), floatBitsToUint(1.0 / gl_FragCoord.w));
    gl_FragDepth = float(min((word.y - floatBitsToUint(near)) >> 4, 0xFFFFFEu)) / 16777215.0;
}
