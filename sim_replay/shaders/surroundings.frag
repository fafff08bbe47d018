#version 330 core
// Sky, clouds and ground along each pixel's ray, with the supersampled aircraft averaged over them.
uniform sampler2D noise;
uniform sampler2D aircraft_colour;
uniform sampler2D aircraft_coordinate;
uniform vec4 environment[9];
uniform vec4 K;                // fx, fy, cx, cy
uniform mat3 ned_from_cam;
uniform vec3 camera_ned_m;
uniform ivec4 tile;            // x, y of the tile; samples across a pixel; 0
uniform ivec4 crop;            // pixels of the tile that the aircraft may touch: x0, y0, x1, y1
uniform ivec2 crop_at;         // its corner in the supersampled buffer
layout(location = 0) out vec4 colour;
layout(location = 1) out vec4 coordinate;

const mat2 turn = mat2(0.80, 0.60, -0.60, 0.80);

vec3 sky(vec3 d) {
    float up = max(-d.z, 0.0);
    vec3 c = mix(environment[2].rgb, environment[3].rgb, pow(1.0 - up, 4.0));
    float s = max(dot(d, environment[0].xyz), 0.0);
    c += environment[1].rgb * environment[8].w * (0.35 * pow(s, 6.0) + 0.5 * pow(s, 60.0) + 2.0 * pow(s, 4000.0));
    float fade = smoothstep(0.015, 0.12, up);
    vec2 plane = d.xy / max(up, 0.015);
    vec2 high = (camera_ned_m.xy + plane * 9000.0) / 40000.0 + environment[8].xy;
    float cirrus = smoothstep(0.4, 0.8, texture(noise, high * vec2(1.0, 2.7)).g) * environment[4].a;
    c = mix(c, environment[4].rgb * 1.1, cirrus * fade);
    vec2 p = (camera_ned_m.xy + plane * (environment[2].a + camera_ned_m.z)) / environment[8].z + environment[8].xy;
    // Octaves turned against each other, and a slow swell, so that the texture's period does not show.
    vec2 p3 = turn * p * 3.3;
    float swell = texture(noise, turn * p * 0.173).g;
    float n = 0.30 * swell + 0.32 * texture(noise, p).r + 0.23 * texture(noise, p3).r
        + 0.15 * texture(noise, turn * p3 * 3.5).b;
    float shade = 0.6 * (n - 0.30 * swell - 0.32 * texture(noise, p + 0.02 * environment[0].xy).r - 0.18);
    float a = smoothstep(environment[0].a, environment[0].a + environment[1].a, n) * fade;
    vec3 cloud = environment[4].rgb * clamp(1.0 + 1.6 * shade - 0.35 * a * (n - environment[0].a), 0.45, 1.3);
    return mix(c, mix(cloud, environment[3].rgb, 0.6 * (1.0 - smoothstep(0.0, 0.4, up))), a);
}

float cell(vec2 i) { return fract(sin(dot(i, vec2(12.9898, 78.233))) * 43758.5453); }

vec3 ground(vec3 d) {
    float range_m = -camera_ned_m.z / max(d.z, 1e-4);
    vec2 g = camera_ned_m.xy + d.xy * range_m;
    float a = environment[7].a;
    g = mat2(cos(a), sin(a), -sin(a), cos(a)) * g;
    float wide = texture(noise, g / 9000.0 + environment[8].xy).r;
    float near = 0.5 + 0.7 * (texture(noise, g / 700.0).r + texture(noise, turn * g / 1130.0).g - 1.0);
    float fine = texture(noise, g / 110.0).b;
    vec3 c;
    if (environment[5].a < 0.5) {
        vec2 q = g / environment[6].a * vec2(1.0, 0.55) + 1.2 * (wide - 0.5);
        float kind = cell(floor(q));
        vec2 edge = abs(fract(q) - 0.5);
        c = mix(environment[5].rgb, environment[6].rgb, kind) * (0.75 + 0.5 * cell(floor(q) + 7.0));
        c = mix(c, environment[7].rgb, max(smoothstep(0.47, 0.49, max(edge.x, edge.y)), smoothstep(0.58, 0.62, near)));
    } else if (environment[5].a < 2.5) {
        c = mix(environment[5].rgb, environment[6].rgb, smoothstep(0.3, 0.7, near));
        c = mix(c, environment[7].rgb, smoothstep(0.55, 0.7, wide));
    } else {
        vec3 normal = normalize(vec3(0.25 * (near - 0.5), 0.25 * (fine - 0.5), -1.0));
        vec3 mirrored = reflect(d, normal);
        float fresnel = 0.03 + 0.97 * pow(1.0 - clamp(dot(-d, normal), 0.0, 1.0), 5.0);
        vec3 above = mix(environment[3].rgb, environment[2].rgb, clamp(-mirrored.z, 0.0, 1.0));
        float glint = pow(max(dot(mirrored, environment[0].xyz), 0.0), 180.0);
        c = mix(environment[5].rgb, above, fresnel) + environment[1].rgb * glint * 1.5;
        c = mix(c, environment[7].rgb, 0.4 * smoothstep(0.68, 0.8, fine));
    }
    c *= 0.7 + 0.6 * mix(fine, near, 0.4);
    return mix(c, environment[3].rgb, 1.0 - exp(-range_m * environment[3].a));
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy) - tile.xy;
    vec3 ray = normalize(ned_from_cam * vec3((vec2(pixel) - K.zw) / K.xy, 1.0));
    vec3 background = ray.z > 0.0 ? ground(ray) : sky(ray);
    vec3 sum = vec3(0.0);
    vec4 body = vec4(0.0);
    float covered = 0.0, hit = 0.0, number = 0.0, share = 0.0;
    coordinate = vec4(0.0);
    if (all(greaterThanEqual(pixel, crop.xy)) && all(lessThan(pixel, crop.zw))) {
        ivec2 corner = crop_at + (pixel - crop.xy) * tile.z;
        for (int j = 0; j < tile.z; ++j) for (int i = 0; i < tile.z; ++i) {
            vec4 c = texelFetch(aircraft_colour, corner + ivec2(i, j), 0);
            vec4 b = texelFetch(aircraft_coordinate, corner + ivec2(i, j), 0);
            sum += c.a * c.rgb * c.rgb;
            covered += c.a;
            if (b.w > 0.5) {
                hit += 1.0;
                // Majority vote (Boyer and Moore): a pixel that two targets share belongs to one of them.
                if (share == 0.0) number = b.w;
                share += b.w == number ? 1.0 : -1.0;
            }
        }
        for (int j = 0; j < tile.z && hit > 0.0; ++j) for (int i = 0; i < tile.z; ++i) {
            vec4 b = texelFetch(aircraft_coordinate, corner + ivec2(i, j), 0);
            if (b.w == number) body += vec4(b.xyz, 1.0);
        }
        float samples = float(tile.z * tile.z);
        sum /= samples; covered /= samples; hit /= samples;
        if (body.w > 0.0) coordinate = vec4(body.xyz / body.w, number);
    }
    // Blue first, as OpenCV stores it; alpha is the share of the pixel that the aircraft covers.
    colour = vec4(sqrt(clamp(sum + (1.0 - covered) * background, 0.0, 1.0)).bgr, hit);
}
