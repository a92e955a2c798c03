// GL_POINTS: one draw a piece, one vertex a point.

void main() {
    uint point = piece.x + uint(gl_VertexID) * piece.z;  // piece: first, count, stride, block
    draw(project(point, block_at(piece.w)), point);
}
