// GL_POINTS: one draw a piece, one vertex a point. Squares lie on whole pixels, so no driver rounds them its own way;
// image row 0 is the framebuffer's row 0, so nothing is flipped on the way back.

in uvec4 piece;  // first, count, stride, block
flat out uvec2 word;

void main() {
    uint point = piece.x + uint(gl_VertexID) * piece.z;
    Square s = project(point, block_at(piece.w));
    vec2 centre = vec2(s.corner) + 0.5 * float(s.side);
    gl_Position = s.visible ? vec4(2.0 * centre / viewport - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = float(s.side);
    word = uvec2(colour[point], s.depth);
}
