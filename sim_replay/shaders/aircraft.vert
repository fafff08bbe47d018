#version 330 core
// Body FRD metres through OpenCV's lens to the clip space of a crop whose row 0 is the image's top row.
uniform mat4 cam_from_body;
uniform mat4 clip_from_cam;
uniform vec4 lens;             // k1, k2, p1, p2
uniform vec2 lens_end;         // k3, squared radius where the model would fold
uniform mat4 shadow_from_body; // to the shadow atlas: u, v and depth in 0..1
uniform vec4 sun_body;         // towards the sun; how far to lift a point off its surface, m
in vec3 in_position;
in vec3 in_normal;
in float in_part;
out vec3 body_m;
out vec3 normal_body;
out vec3 shadow_at;
flat out int part;
void main() {
    body_m = in_position;
    normal_body = in_normal;
    part = int(in_part + 0.5);
    float facing = dot(in_normal, sun_body.xyz) < 0.0 ? -1.0 : 1.0;
    shadow_at = (shadow_from_body * vec4(in_position + facing * sun_body.w * in_normal, 1.0)).xyz;
    vec4 cam = cam_from_body * vec4(in_position, 1.0);
    vec2 p = cam.xy / cam.z;
    float r2 = min(dot(p, p), lens_end.y);
    float radial = 1.0 + r2 * (lens.x + r2 * (lens.y + r2 * lens_end.x));
    p = p * radial + 2.0 * p.x * p.y * lens.zw + lens.wz * (r2 + 2.0 * p * p);
    gl_Position = clip_from_cam * vec4(p * cam.z, cam.z, 1.0);
}
