// Mapping of values: which objects are drawn, and their colour. Uniforms, so that nothing is sent again to change it.

uniform sampler2D gradient;      // one row
uniform vec2 value_range;        // values at the ends of the gradient
uniform vec2 value_filter;       // least and largest value that is drawn

bool is_drawn(float value) {
    return value >= value_filter.x && value <= value_filter.y;
}

vec3 colour_of(float value) {
    float span = value_range.y - value_range.x;
    float t = span != 0.0 ? clamp((value - value_range.x) / span, 0.0, 1.0) : 0.5;
    return textureLod(gradient, vec2((t * 255.0 + 0.5) / 256.0, 0.5), 0.0).rgb;
}
