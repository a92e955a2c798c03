// Independent chains of multiply-adds: four vec4 a thread, two operations an element and round.
layout(local_size_x = 64) in;
layout(std430, binding = 0) writeonly buffer Out { float result[]; };
uniform int rounds;

void main() {
    vec4 a = vec4(gl_LocalInvocationID.x), b = a + 1.0, c = a + 2.0, d = a + 3.0;
    for (int i = 0; i < rounds; i++) {
        a = a * 0.999 + 0.001;
        b = b * 0.999 + 0.001;
        c = c * 0.999 + 0.001;
        d = d * 0.999 + 0.001;
    }
    result[gl_GlobalInvocationID.x] = dot(a + b + c + d, vec4(1.0));
}
