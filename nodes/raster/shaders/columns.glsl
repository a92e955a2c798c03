// One chunk of the point-array.

layout(std430, binding = 0) restrict readonly buffer PositionX { float x[]; };
layout(std430, binding = 1) restrict readonly buffer PositionY { float y[]; };
layout(std430, binding = 2) restrict readonly buffer PositionZ { float z[]; };
layout(std430, binding = 3) restrict readonly buffer Colour { uint colour[]; };
