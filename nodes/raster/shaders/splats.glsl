// A splat in eye space (axes right, down, forward), made once a frame and read by both passes that draw it.

struct Splat {
    vec2 place;     // of its centre on the image, pixels
    float w;        // depth of its centre
    float radius;   // world units; negative: no part in visibility, a quad stands for it
    vec2 gradient;  // its plane has the depth w / (1 + gradient · (pixel − place))
    uint colour;    // 11, 11 and 10 bits of 0…255
    uint reach;     // half width and height of what it may cover, pixels, two half floats; 0: nothing
};

const float FLOAT_MAX = 3.4028234e38;

uniform vec2 viewport;  // pixels
uniform vec2 focal;     // image position = focal · (x, y) / w + center
uniform vec2 center;
uniform float near;
