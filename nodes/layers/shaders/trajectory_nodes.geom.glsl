// Nodes as balls, an invocation a band, or as discs that face the camera. Goes behind trajectory_input.glsl, ball.glsl,
// emit.glsl.

layout(points, invocations = BANDS) in;
layout(triangle_strip, max_vertices = 2 * SIDES + 2) out;

void main() {
    Node here = node(0);
    float radius = ball_of(here);
    if (radius == 0.0 || (radius < 0.0 && gl_InvocationID > 0)) return;
    vec3 colour = colour_of(here.value), middle = here.position;
    if (radius > 0.0) {
        for (int i = 0; i < 2 * SIDES + 2; ++i) {
            vec3 normal = ball_normal(gl_InvocationID, 1 - (i & 1), i >> 1);
            emit(middle + radius * normal, normal, colour);
        }
    } else {
        vec3 normal = direction(eye - middle), u, v;
        across(normal, u, v);
        for (int i = 0; i < 2 * SIDES; ++i) {  // 0, 1, −1, 2, −2 …
            float angle = 3.14159265 / SIDES * ((i & 1) != 0 ? (i + 1) >> 1 : -(i >> 1));
            emit(middle - radius * (cos(angle) * u + sin(angle) * v), normal, colour);
        }
    }
    EndPrimitive();
}
