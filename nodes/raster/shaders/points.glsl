// The projection of a point of the point-array; goes behind columns.glsl and squares.glsl.

// The sums are written out and precise, so that they round as on the CPU.
Square project(uint point, Block block) {
    vec4 rx = block.rows[0], ry = block.rows[1], rw = block.rows[2];
    float px = x[point], py = y[point], pz = z[point];
    precise float u = rx.x * px + rx.y * py + rx.z * pz + rx.w;
    precise float v = ry.x * px + ry.y * py + ry.z * pz + ry.w;
    precise float w = rw.x * px + rw.y * py + rw.z * pz + rw.w;
    Square square = square_of(u, v, w, block);
    bool kept = (floatBitsToUint(px) & 0x7FFFFFFFu) <= 0x7F800000u;  // no NaN: GLSL promises nothing of comparing one
    square.visible = square.visible && kept;
    return square;
}

uint colour_of(uint point) {
    return colour[point];
}
