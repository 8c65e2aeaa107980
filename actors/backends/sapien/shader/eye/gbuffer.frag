#version 450
// What the robot's eye sees: no shadows.

#include "../common/surface.glsl"

layout(location = 0) in vec3 worldNormal;
layout(location = 1) in vec2 textureUV;
layout(location = 0) out vec4 outColor;

void main() {
  if (isScreen()) {
    outColor = screenColor(textureUV);
    return;
  }
  vec3 normal = normalize(worldNormal);
  outColor = litColor(skylight(normal) + sunlight(normal));
}
