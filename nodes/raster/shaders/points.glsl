// What every program that draws points shares: one chunk of the point-array, the matrices of the blocks, and the
// projection of a point. Put in front of the program's own source.
// SQUARES: points cover more than one pixel.

layout(std430, binding = 0) restrict readonly buffer PositionX { float x[]; };
layout(std430, binding = 1) restrict readonly buffer PositionY { float y[]; };
layout(std430, binding = 2) restrict readonly buffer PositionZ { float z[]; };
layout(std430, binding = 3) restrict readonly buffer Colour { uint colour[]; };
layout(std430, binding = 4) restrict readonly buffer Rows { mat3x4 rows[]; };  // columns are X, Y, W of a block

const float FLOAT_MAX = 3.4028234e38;

uniform vec2 viewport;  // pixels
uniform float near;
#ifdef SQUARES
uniform float world_px;      // side in world units × focal length in pixels; 0: fixed side
uniform vec2 side_range_px;  // least, largest
#endif

struct Square {
    bool visible;
    ivec2 corner;  // pixel of least column and row; may lie outside the image
    int side;
    uint depth;    // bits of the distance along the view axis
};

// The sums are written out and precise, so that they round as on the CPU.
Square project(uint point, mat3x4 block) {
    vec4 rx = block[0], ry = block[1], rw = block[2];
    float px = x[point], py = y[point], pz = z[point];
    precise float w = rw.x * px + rw.y * py + rw.z * pz + rw.w;
    precise float u = (rx.x * px + rx.y * py + rx.z * pz + rx.w) / w;
    precise float v = (ry.x * px + ry.y * py + ry.z * pz + ry.w) / w;
    precise vec2 corner = vec2(u, v);
    float side = 1.0;
#ifdef SQUARES
    side = world_px > 0.0 ? floor(clamp(world_px / w, side_range_px.x, side_range_px.y) + 0.5) : side_range_px.x;
    corner -= 0.5 * (side - 1.0);
#endif
    corner = floor(corner);
    bool visible = w >= near && w <= FLOAT_MAX
        && all(greaterThan(corner + side, vec2(0.0))) && all(lessThan(corner, viewport));
    return Square(visible, ivec2(corner), int(side), floatBitsToUint(w));
}
