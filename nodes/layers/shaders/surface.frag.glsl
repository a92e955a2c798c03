// Lit surfaces: a word is the colour and the depth's bits. The binding offers 24-bit depth buffers only, so they get
// the depth as a logarithm: the float's bits counted from ``near``, 16 steps to one.

in vec3 layer_position;
#ifdef FLAT
flat in vec3 layer_normal;
#else
in vec3 layer_normal;
#endif
flat in vec3 base_colour;  // linear in what is stored, 0…1
layout(location = 0) out uvec2 word;
uniform float near;
uniform vec3 eye;

const vec3 KEY = vec3(0.387298, 0.258199, 0.885061);  // light from above, beside
const float AMBIENT = 0.42, DIFFUSE = 0.5, HEAD = 0.12;

void main() {
    vec3 n = normalize(layer_normal), view = normalize(eye - layer_position);
    if (dot(n, view) < 0.0) n = -n;
    float light = AMBIENT + DIFFUSE * max(dot(n, KEY), 0.0) + HEAD * dot(n, view);
    float depth = 1.0 / gl_FragCoord.w;
    word = uvec2(packUnorm4x8(vec4(min(base_colour * light, 1.0), 1.0)), floatBitsToUint(depth));
    gl_FragDepth = float(min((word.y - floatBitsToUint(near)) >> 4, 0xFFFFFEu)) / 16777215.0;
}
