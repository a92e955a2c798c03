// A fragment of a splat. PASS_VISIBILITY: its depth, the least of which stays by blending.
// PASS_COLOUR: weighted colour and weight, added up; the least depth, if it is not behind the visible surface.

flat in vec4 place_w_radius;
flat in vec2 gradient;
#ifdef PASS_COLOUR
flat in vec3 rgb;
uniform sampler2D front;
uniform float depth_offset;  // radii
uniform float falloff;
const float MOST_OFFSET = 1e38;  // closed pixels stay closed: see reopen.frag.glsl
layout(location = 0) out vec4 sum;  // weight · colour, depth
layout(location = 1) out float weight;
#else
layout(location = 0) out float front;
#endif
uniform float screen_radius_px;

void main() {
    vec2 delta = gl_FragCoord.xy - place_w_radius.xy;
    float w = place_w_radius.z, radius = place_w_radius.w;
    precise float slope = gradient.x * delta.x + gradient.y * delta.y;
    precise float t = w / (1.0 + slope);  // where the ray meets the plane
    vec3 p = vec3((place_w_radius.xy - center) / focal * w, w);
    precise vec3 off = (vec3(t * delta / focal, 0.0) - p * (slope / (1.0 + slope))) / radius;
    precise float disc = off.x * off.x + off.y * off.y + off.z * off.z;
    precise vec2 close = delta / screen_radius_px;
    precise float screen = close.x * close.x + close.y * close.y;
    bool nearer = t >= near && t <= FLOAT_MAX && disc < screen;  // false for NaN, too
    float rho_2 = nearer ? disc : screen;
    float depth = nearer ? t : w;
    if (!(rho_2 <= 1.0)) discard;
#ifdef PASS_COLOUR
    precise float least = depth - min(depth_offset * radius, MOST_OFFSET);
    if (least > texelFetch(front, ivec2(gl_FragCoord.xy), 0).r) discard;
    weight = exp(-falloff * rho_2);
    sum = vec4(weight * rgb, depth);
#else
    front = depth;
#endif
}
