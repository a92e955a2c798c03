// Arcs by hardware instancing: a template of all segments. Goes behind gradient.glsl, arc.glsl, output.glsl.

in vec2 part;           // the template: where its segment starts and ends, 0 … 1
in ivec2 corner_face;   // and which corner and face a vertex belongs to; sides have 8 added to the corner
in vec2 center, angle, radius, height;
in float value;

void main() {
    vec2 ends = mix(angle.xx, angle.yy, part);
    if (part.y == 1.0) ends.y = angle.y;
    bool closed = angle.y - angle.x >= 6.283180;
    bool drawn = is_drawn(value) && !(closed && corner_face.x >= 8);
    vec2 heights = vec2(min(height.x, height.y), max(height.x, height.y));
    put(arc_corner(corner_face.x & 7, center, ends, radius, heights), arc_normal(corner_face.y, ends),
        colour_of(value), drawn);
}
