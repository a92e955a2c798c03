// A square as a GL_POINT. It lies on whole pixels, so no driver rounds it its own way; image row 0 is the framebuffer's
// row 0, so nothing is flipped on the way back.

in uvec4 piece;
flat out uvec2 word;

void draw(Square s, uint point) {
    vec2 centre = vec2(s.corner) + 0.5 * float(s.side);
    gl_Position = s.visible ? vec4(2.0 * centre / viewport - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = float(s.side);
    word = uvec2(colour_of(point), s.depth);
}
