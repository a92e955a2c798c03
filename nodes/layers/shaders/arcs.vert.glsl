// Transfer function of arcs: the record, its colour, and how many segments its size on the screen asks for.
// Goes behind gradient.glsl, arc.glsl.

in vec2 center, angle, radius, height;
in float value;
out Arc { vec2 center, angle, radius, height; vec3 colour; float root; } arc;
uniform vec3 eye;
uniform float near, focal_px;

void main() {
    arc.center = center;
    arc.angle = angle;
    arc.radius = radius;
    arc.height = vec2(min(height.x, height.y), max(height.x, height.y));
    arc.colour = colour_of(value);
    float wanted = segments;
    if (wanted == 0.0) {
        // a chord over the angle 2a is r (1 − cos a) off the arc, about r a² / 2
        float gap = max(0.0, length(vec3(center, arc.height.y) - eye) - radius.y);
        float radius_px = radius.y * focal_px / max(gap, near);
        wanted = 0.5 * (angle.y - angle.x) * sqrt(0.5 * radius_px / tolerance_px);
    }
    arc.root = is_drawn(value) ? clamp(ceil(sqrt(wanted)), 2.0, 64.0) : 0.0;
}
