// Points → splats, one invocation a point: everything about a splat that does not depend on the pixel.
// Source: thesis 4.4.3 and Appendix C. The names of constants are those of splat_geometry.py.

layout(std430, binding = 4) restrict readonly buffer Normal { uint normal_word[]; };
layout(std430, binding = 5) restrict readonly buffer RadiusCode { uint radius_codes[]; };  // four a word
layout(std430, binding = 8) restrict writeonly buffer Splats { Splat splats[]; };

uniform float radius_of[256];  // world units
uniform float max_splat_px;
uniform float screen_radius_px;
uniform float focal_px;
uniform vec3 light;
uniform float ambient;
uniform bool lighting;

const uint NO_NORMAL = 0x80008000u;
const uint HAS_QUAD = 0x80000000u;  // mark of a run's block
const float ROUNDING_PX = 0.05;     // more than the corners of a quad move when they are rounded

vec3 unpack_normal(uint word) {
    vec2 o = vec2(int(word) << 16 >> 16, int(word) >> 16) / 32767.0;
    vec3 n = vec3(o, 1.0 - abs(o.x) - abs(o.y));
    vec2 side = vec2(o.x >= 0.0 ? 1.0 : -1.0, o.y >= 0.0 ? 1.0 : -1.0);
    if (n.z < 0.0) n.xy = (1.0 - abs(o.yx)) * side;
    return normalize(n);
}

vec3 lit(vec3 rgb, vec3 n, vec3 towards_eye) {
    vec3 between = towards_eye + light;
    float c = max(dot(between / max(length(between), 1e-12), n), 0.0);
    c *= c; c *= c; c *= c; c *= c; c *= c;  // shininess 32
    return clamp(rgb * (max(dot(n, light), 0.0) + ambient) + 255.0 * c, 0.0, 255.0);
}

// Half the width of a disc's image about its centre, along the axis whose image position is 0 at the centre and grows
// with dot(row, ·) / w. The lines of that direction that touch the ellipse: a quadratic without cancellation.
float half_width(vec3 row, vec3 n, float w, float radius) {
    float square = radius * radius;
    float a = w * w - square * max(1.0 - n.z * n.z, 0.0);
    if (!(a > 1e-4 * w * w)) return max_splat_px;  // about to reach behind the eye
    float b = -square * n.z * dot(row, n) + square * row.z;
    float c = square * max(dot(row, row) - dot(row, n) * dot(row, n), 0.0);
    return (abs(b) + sqrt(b * b + a * c)) / a;
}

void main() {
    uint i = invocation();
    if (i >= n_units) return;
    Run run = runs[run_of(first_unit + i)];
    uint point = run.first + (first_unit + i - run.first_unit) * run.stride;
    mat3x4 block = rows[run.block & ~HAS_QUAD];
    vec4 position = vec4(x[point], y[point], z[point], 1.0);
    vec3 p = position * block;
    Splat splat = Splat(vec2(0.0), 0.0, 0.0, vec2(0.0), 0u, 0u);
    bool kept = (floatBitsToUint(position.x) & 0x7FFFFFFFu) <= 0x7F800000u;  // as in points.glsl
    if (kept && all(lessThanEqual(abs(p), vec3(FLOAT_MAX))) && p.z >= near) {
        float largest = max(max(abs(p.x), abs(p.y)), p.z);  // divided by first, so that nothing overflows
        vec3 towards_eye = -normalize(p / largest);
        uint word = normal_word[point];
        vec3 n = word == NO_NORMAL ? towards_eye : unpack_normal(word) * mat3(block);
        if (dot(n, p) > 0.0) n = -n;

        float w = p.z;
        uint code = radius_codes[point / 4u] >> (point % 4u * 8u) & 255u;
        float radius = max(min(radius_of[code], max_splat_px * w / focal_px), 1e-30);
        vec2 place = focal * p.xy / w + center;
        vec2 reach = vec2(half_width(vec3(focal.x, 0.0, center.x - place.x), n, w, radius),
                          half_width(vec3(0.0, focal.y, center.y - place.y), n, w, radius));
        reach = min(max(reach * 1.001, screen_radius_px) + ROUNDING_PX, max_splat_px);
        if (all(greaterThan(place + reach, vec2(0.0))) && all(lessThan(place - reach, viewport))) {
            vec3 rgb = vec3(colour[point] & 255u, colour[point] >> 8 & 255u, colour[point] >> 16 & 255u);
            if (lighting && word != NO_NORMAL) rgb = lit(rgb, n, towards_eye);
            uvec3 bits = uvec3(rgb * vec3(8.0, 8.0, 4.0) + 0.5);
            bool has_quad = (run.block & HAS_QUAD) != 0u;
            splat = Splat(place, w, has_quad ? -radius : radius, w * n.xy / (focal * dot(n, p)),
                          bits.r | bits.g << 11 | bits.b << 22, packHalf2x16(reach));
        }
    }
    splats[i] = splat;
}
