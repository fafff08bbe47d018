#version 330 core
// Sun, sky and ground light on paint, then haze. Colour leaves with gamma 2 in eight bits.
uniform sampler2D noise;
uniform vec4 environment[9];
uniform vec4 livery[11];       // 0-7 palette and gloss; 8 camouflage, share; 9 marking, tip; 10 band x, width, offset
uniform mat3 ned_from_body;
uniform vec3 camera_body_m;
uniform vec4 extent;           // 1/diameter, half span m, length m, target number
uniform ivec2 corner;          // of this crop in the supersampled buffer
in vec3 body_m;
in vec3 normal_ned;
flat in int part;
layout(location = 0) out vec4 colour;
layout(location = 1) out vec4 coordinate;

const int WING = 1, TAIL = 2, PROPELLER_DISC = 7;

vec3 paint() {
    vec3 albedo = livery[part].rgb;
    if (part > TAIL) return albedo;
    vec2 skin = vec2(body_m.x, part == WING ? body_m.y : body_m.y + body_m.z) / extent.z;
    float grain = texture(noise, skin * 0.9 + livery[10].zw).r;
    if (livery[8].a > 0.0 && grain > 1.0 - livery[8].a) albedo = livery[8].rgb;
    bool tip = part == WING && abs(body_m.y) > livery[9].a * extent.y;
    bool band = part != WING && abs(body_m.x / extent.z - livery[10].x) < livery[10].y;
    if (tip || band) albedo = livery[9].rgb;
    return albedo * (0.88 + 0.24 * texture(noise, skin * 3.0).b);
}

void main() {
    if (part == PROPELLER_DISC) {
        // Screen-door: a turning propeller leaves about an eighth of its disc, less than half of any pixel.
        float hash = fract(52.9829189 * fract(dot(floor(gl_FragCoord.xy) - vec2(corner), vec2(0.06711056, 0.00583715))));
        if (hash > 0.13) discard;
    }
    vec3 to_camera = camera_body_m - body_m;
    float range_m = length(to_camera);
    vec3 view = ned_from_body * (to_camera / range_m);
    vec3 n = normalize(normal_ned);
    if (dot(n, view) < 0.0) n = -n;
    vec3 sun = environment[0].xyz;
    float direct = max(dot(n, sun), 0.0);
    vec3 sky = mix(environment[3].rgb, environment[2].rgb, 0.5) * 0.9;
    vec3 ground = environment[5].rgb + 0.12 * environment[3].rgb;
    vec3 light = environment[1].rgb * direct + mix(ground, sky, 0.5 - 0.5 * n.z);
    float highlight = pow(max(dot(n, normalize(sun + view)), 0.0), 40.0) * step(0.0, dot(n, sun));
    float fresnel = pow(1.0 - max(dot(n, view), 0.0), 4.0);
    vec3 shaded = paint() * light + livery[0].a * (environment[1].rgb * highlight + 0.35 * fresnel * sky);
    float haze = 1.0 - exp(-range_m * environment[3].a);
    shaded = mix(shaded, environment[3].rgb, haze);
    colour = vec4(sqrt(clamp(shaded, 0.0, 1.0)), 1.0);
    coordinate = vec4(body_m * extent.x, part == PROPELLER_DISC ? 0.0 : extent.w);
}
