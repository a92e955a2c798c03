// root × root segments: root lines of root segments each. A level of 0 leaves the arc out.

layout(vertices = 1) out;
in Arc { vec2 center, angle, radius, height; vec3 colour; float root; } arc[];
patch out Patch { vec2 center, angle, radius, height; vec3 colour; float root; } whole;

void main() {
    gl_TessLevelOuter[0] = gl_TessLevelOuter[1] = arc[0].root;
    whole.center = arc[0].center;
    whole.angle = arc[0].angle;
    whole.radius = arc[0].radius;
    whole.height = arc[0].height;
    whole.colour = arc[0].colour;
    whole.root = arc[0].root;
}
