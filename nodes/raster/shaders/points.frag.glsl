// The binding offers 24-bit depth buffers only, so they get the depth as a logarithm: the float's bits counted from
// ``near``, 16 steps to one, which tells depths apart that differ by 2 in a million up to 2³² × near.

flat in uvec2 word;
layout(location = 0) out uvec2 fragment;  // colour, depth bits: a framebuffer word
uniform float near;

void main() {
    fragment = word;
    gl_FragDepth = float(min((word.y - floatBitsToUint(near)) >> 4, 0xFFFFFEu)) / 16777215.0;
}
