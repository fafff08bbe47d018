// The surroundings of a whole frame without any aircraft; alpha is what cloud before the aircraft hides.
uniform sampler2D far_sky;
uniform sampler2D backdrop;
uniform vec4 backdrop_map;     // turn rad, width rad, height / width; 0: no backdrop, 1: photograph, 2: panorama
layout(location = 0) out vec4 colour;

vec3 pictured(vec3 d) {
    float azimuth = atan(d.y, d.x) + backdrop_map.x, elevation = asin(clamp(-d.z, -1.0, 1.0));
    vec2 at = vec2(azimuth, -elevation) / (backdrop_map.y * vec2(1.0, backdrop_map.z)) + 0.5;
    // A photograph repeats mirrored. The level is given: where the azimuth wraps round, its derivative means nothing.
    if (backdrop_map.w < 1.5) at = 1.0 - abs(mod(at, 2.0) - 1.0);
    float texels = float(textureSize(backdrop, 0).x) / (backdrop_map.y * K.x);
    return textureLod(backdrop, at, max(log2(texels), 0.0)).rgb;
}

void main() {
    vec2 pixel = floor(gl_FragCoord.xy);
    vec3 ray = ray_ned(pixel);
    vec3 background;
    if (backdrop_map.w > 0.5) {
        background = pictured(ray);
        background *= background;
    } else if (ray.z > 0.0) {
        background = ground(ray);
    } else {
        background = texture(far_sky, (pixel + 0.5) * 0.5 / vec2(textureSize(far_sky, 0))).rgb;
        background *= background;
        if (environment[9].y > 0.0) background = hills(ray, background);
    }
    background += veil(ray);
    colour = vec4(sqrt(clamp(background, 0.0, 1.0)).bgr, near_cloud(ray));
}
