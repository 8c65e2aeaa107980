#version 450
// Transforms the vertices of one shape. SAPIEN binds its buffers by these declarations.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} camera;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} object;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectData;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;

layout(location = 0) out vec3 worldNormal;
layout(location = 1) out vec2 textureUV;

void main() {
  // No shape is scaled, so normals are rotated as the shape is.
  worldNormal = mat3(object.modelMatrix) * normal;
  textureUV = uv;
  gl_Position =
      camera.projectionMatrix * camera.viewMatrix * object.modelMatrix * vec4(position, 1.0);
}
