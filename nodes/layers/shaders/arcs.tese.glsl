// Ends of segments, put one after the other along the arc by whole numbers, so that neighbours share them exactly.

layout(isolines, equal_spacing) in;
patch in Patch { vec2 center, angle, radius, height; vec3 colour; float root; } whole;
out Vertex { vec2 center, radius, height; vec3 colour; float angle; int side; } vertex;

void main() {
    float n = whole.root;
    float place = round(gl_TessCoord.y * n) * n + round(gl_TessCoord.x * n);  // 0 … n²
    float last = n * n;
    vertex.center = whole.center;
    vertex.radius = whole.radius;
    vertex.height = whole.height;
    vertex.colour = whole.colour;
    vertex.angle = place == last ? whole.angle.y : mix(whole.angle.x, whole.angle.y, place / last);
    bool closed = whole.angle.y - whole.angle.x >= 6.283180;
    vertex.side = int((place == 0.0 || place == last) && !closed);
}
