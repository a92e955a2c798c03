// Quads reach a little beyond their splats. Pixels where they hide every splat are opened for both passes once more;
// where there is a colour, pixels are closed: no depth is less.

uniform sampler2D weights;
layout(location = 0) out float front;

void main() {
    front = texelFetch(weights, ivec2(gl_FragCoord.xy), 0).r > 0.0 ? -3.4028234e38 : 3.4028234e38;
}
