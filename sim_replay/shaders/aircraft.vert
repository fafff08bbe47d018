#version 330 core
// Body FRD metres to the clip space of a crop whose row 0 is the image's top row.
uniform mat4 clip_from_body;
uniform mat3 ned_from_body;
in vec3 in_position;
in vec3 in_normal;
in float in_part;
out vec3 body_m;
out vec3 normal_ned;
flat out int part;
void main() {
    body_m = in_position;
    normal_ned = ned_from_body * in_normal;
    part = int(in_part + 0.5);
    gl_Position = clip_from_body * vec4(in_position, 1.0);
}
