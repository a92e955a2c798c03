// Balls: a strip a band, as wide as a tube's. SIDES: around, BANDS: from pole to pole.

vec3 ball_normal(int band, int end, int side) {
    float turn = 6.28318531 / SIDES * (side % SIDES), down = 3.14159265 / BANDS * (band + 1 - end);
    return vec3(sin(down) * cos(turn), sin(down) * sin(turn), cos(down));
}
