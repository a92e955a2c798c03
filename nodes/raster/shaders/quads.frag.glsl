// Depth of a quad, where the ray of the pixel meets it.

flat in vec3 middle, a, b;
layout(location = 0) out float front;

void main() {
    vec3 ray = vec3((gl_FragCoord.xy - center) / focal, 1.0), n = cross(a, b);
    float t = dot(n, middle) / dot(n, ray);
    vec3 off = t * ray - middle;
    bool hit = t >= near && t <= FLOAT_MAX && abs(dot(off, a)) <= dot(a, a) && abs(dot(off, b)) <= dot(b, b);
    if (!hit) discard;
    front = t;
}
