// Where the square of a point lies on the image; goes behind rows.glsl.
// SQUARES: points cover more than one pixel.  ADAPTIVE: each block has a side of its own.

const float FLOAT_MAX = 3.4028234e38;

uniform vec2 viewport;  // pixels
uniform float near;
#ifdef SQUARES
uniform vec2 side_range_px;  // least, largest
#ifdef ADAPTIVE
layout(std430, binding = 11) restrict readonly buffer Sides { float world_px[]; };
#else
uniform float world_px;  // side in world units × focal length in pixels; 0: fixed side
#endif
#endif

struct Square {
    bool visible;
    ivec2 corner;  // pixel of least column and row; may lie outside the image
    int side;
    uint depth;    // bits of the distance along the view axis
};

// The matrix and side of a block, fetched out of the loop over its points: a compiler may not know that they stay.
struct Block {
    mat3x4 rows;
    float world_px;
};

Block block_at(uint place) {
#if defined(ADAPTIVE)
    return Block(rows[place], world_px[place]);
#elif defined(SQUARES)
    return Block(rows[place], world_px);
#else
    return Block(rows[place], 0.0);
#endif
}

// Of a point at (x / w, y / w) on the image and at the depth w.
Square square_of(float x, float y, float w, Block block) {
    precise float u = x / w;
    precise float v = y / w;
    precise vec2 corner = vec2(u, v);
    float side = 1.0;
#ifdef SQUARES
    side = block.world_px > 0.0
        ? floor(clamp(block.world_px / w, side_range_px.x, side_range_px.y) + 0.5) : side_range_px.x;
    corner -= 0.5 * (side - 1.0);
#endif
    corner = floor(corner);
    bool visible = w >= near && w <= FLOAT_MAX
        && all(greaterThan(corner + side, vec2(0.0))) && all(lessThan(corner, viewport));
    return Square(visible, ivec2(corner), int(side), floatBitsToUint(w));
}
