// Normalisation: sums → framebuffer words, empty where nothing was added.

uniform sampler2D sums;     // Σ weight · colour, least depth
uniform sampler2D weights;  // Σ weight
layout(location = 0) out uvec2 word;  // colour, depth bits

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 sum = texelFetch(sums, pixel, 0);
    float weight = texelFetch(weights, pixel, 0).r;
    uvec3 rgb = uvec3(clamp(sum.rgb / weight + 0.5, 0.0, 255.0));
    word = weight > 0.0 ? uvec2(rgb.r | rgb.g << 8 | rgb.b << 16 | 0xFF000000u, floatBitsToUint(sum.a)) : uvec2(~0u);
}
